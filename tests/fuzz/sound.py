"""A sound file with the ways to change it, and the commands that read it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

from tests.fuzz.changes import changed_bytes, changed_json, changed_words, changed_yaml
from tests.fuzz.structures import (
    changed_archive,
    changed_db3,
    changed_map,
    changed_mcap,
    changed_ros1,
)

Change = Callable[[bytes, Random], bytes]
READ, CASE, OUT = "read", "CASE", "OUT"


@dataclass(frozen=True)
class Sound:
    """A sound file, how it may be changed, and what is done with it then.

    Attributes
    ----------
    kind
        What it is called in tables.
    path
        The file.
    changes
        By name.
    commands
        Words of each command; `CASE` stands for the changed file and `OUT` for what is written.
        The first word `read` stands for a function of `tests.fuzz.readers`.
    beside
        Files that are laid beside it.
    computes
        Whether commands take seconds also with the sound file.
    """

    kind: str
    path: Path
    changes: dict[str, Change]
    commands: tuple[tuple[str, ...], ...]
    beside: tuple[Path, ...] = ()
    computes: bool = False


BYTES: dict[str, Change] = {"bytes": changed_bytes}
WORDS: dict[str, Change] = {"bytes": changed_bytes, "words": changed_words}
PLAIN_YAML: dict[str, Change] = {**WORDS, "values": changed_yaml}
PLAIN_JSON: dict[str, Change] = {"bytes": changed_bytes, "values": changed_json}
MAPS: dict[str, Change] = {**BYTES, "arrays": changed_map, "members": changed_archive}
BAGS: dict[str, dict[str, Change]] = {
    ".bag": {**BYTES, "records": changed_ros1},
    ".mcap": {**BYTES, "records": changed_mcap},
    ".db3": {**BYTES, "cells": changed_db3},
}

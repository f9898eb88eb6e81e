"""YAML that is read within bounds: counted while it is parsed, before anything is made of it."""

from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionEndEvent,
    CollectionStartEvent,
    DocumentStartEvent,
    Event,
    NodeEvent,
)
from ruamel.yaml.parser import Parser

from l2m_gtsam.storage.bounded import read_content

MAX_BYTES = 2_000_000  # a calibration of a hundred sensors is half of it; ten seconds
MAX_DEPTH = 40  # ours are nested in ten levels
# With aliases in full: they are shared in memory, but not by what walks over the content.
MAX_NODES = 400_000


class TooMuchYAMLError(YAMLError):
    """A document that is nested too deep, or that has too many nodes with its aliases in full."""


class _BoundedParser(Parser):
    """Counts the nodes that come, with aliases in full, and how deep they are nested."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._open: list[tuple[str | None, int]] = []  # anchor, and nodes before it
        self._sizes: dict[str, int] = {}
        self._nodes = 0

    def get_event(self) -> Any:
        """Return the next event; a TooMuchYAMLError beyond the bounds."""
        event = super().get_event()
        if event is not None:
            self._count(event)
        return event

    def _count(self, event: Event) -> None:
        if isinstance(event, DocumentStartEvent):
            self._open, self._sizes = [], {}
        elif isinstance(event, CollectionEndEvent):
            anchor, before = self._open.pop()
            if anchor is not None:
                self._sizes[anchor] = self._nodes - before
        elif isinstance(event, AliasEvent):
            if event.anchor in (anchor for anchor, _ in self._open):
                raise TooMuchYAMLError(f"&{event.anchor} holds itself")
            self._nodes += self._sizes.get(event.anchor, 1)
        elif isinstance(event, NodeEvent):
            if isinstance(event, CollectionStartEvent):
                self._open.append((event.anchor, self._nodes))
            elif event.anchor is not None:
                self._sizes[event.anchor] = 1
            self._nodes += 1
        if len(self._open) > MAX_DEPTH:
            raise TooMuchYAMLError(f"nested more than {MAX_DEPTH} levels deep")
        if self._nodes > MAX_NODES:
            raise TooMuchYAMLError(f"more than {MAX_NODES:,} values, aliases counted in full")


class BoundedYAML(YAML):
    """A reader of plain values, whatever it is asked to be, within bounds."""

    def __init__(self, **_: Any) -> None:
        super().__init__(typ="safe", pure=True)
        self.Parser = _BoundedParser

    def load(self, stream: Any) -> Any:
        """Return the content of a text, or of a file.

        Raises
        ------
        YAMLError
            It is not YAML, or there is too much of it.
        """
        if isinstance(stream, Path):
            stream = read_content(stream, MAX_BYTES)
        elif not isinstance(stream, str | bytes):
            stream = stream.read(MAX_BYTES + 1)
        if len(stream) > MAX_BYTES:
            raise TooMuchYAMLError(f"larger than {MAX_BYTES / 1e6:g} MB")
        try:
            return super().load(stream)
        except OverflowError as reason:  # moved to UTC, year 1 or 9999 may be left
            why = "has a date that no calendar holds; accepted: years 2 to 9998"
            raise YAMLError(why) from reason
        except (ValueError, TypeError, AttributeError, KeyError, IndexError) as reason:
            raise YAMLError(" ".join(str(reason).split())[:100]) from reason
        except RecursionError as reason:
            raise TooMuchYAMLError("nested too deep") from reason

"""Bags in a folder."""

import os
from collections.abc import Iterator
from pathlib import Path

FILES = (".bag", ".mcap", ".db3")
ROS2_HEADER = "metadata.yaml"


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: by the name of a file, or by what a folder holds."""
    if path.is_dir():
        return (path / ROS2_HEADER).is_file()
    return path.suffix.lower() in FILES


def find_bags(folder: Path, without: Path) -> list[Path]:
    """Return every bag in a folder and below it, in order of their paths.

    Parameters
    ----------
    folder
        Itself a bag, or where they are looked for; links to folders that are no bag are not
        followed, names that begin with a dot are skipped.
    without
        Folder that is not looked into.
    """
    return [folder] if is_bag(folder) else sorted(_below(folder, without.resolve()))


def _below(folder: Path, without: Path) -> Iterator[Path]:
    for name, folders, files in os.walk(folder):
        place = Path(name)
        inside = [place / each for each in folders if not each.startswith(".")]
        bags = [each for each in inside if is_bag(each)]
        yield from bags
        folders[:] = [
            each.name for each in inside if each not in bags and each.resolve() != without
        ]
        yield from (place / each for each in files if not each.startswith(".") and _named(each))


def _named(name: str) -> bool:
    return Path(name).suffix.lower() in FILES

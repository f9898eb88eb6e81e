"""Bags in a folder."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

from l2m_gtsam.errors import BagError

FILES = (".bag", ".mcap", ".db3")
ROS2_HEADER = "metadata.yaml"


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: by the name of a file, or by what a folder holds.

    Raises
    ------
    BagError
        It cannot be told, because a folder cannot be read.
    """
    if is_folder(path):
        try:
            return (path / ROS2_HEADER).is_file()
        except OSError as error:
            _unreadable(path, error)
    return _named(path.name)


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder; a BagError if the one that it lies in is closed."""
    try:
        return path.is_dir()
    except OSError as error:
        _unreadable(path, error)


def find_bags(folder: Path, without: Path) -> list[Path]:
    """Return every bag in a folder and below it, in order of their paths.

    Parameters
    ----------
    folder
        Itself a bag, or where they are looked for; links to folders that are no bag are not
        followed, names that begin with a dot are skipped.
    without
        Folder that is not looked into.

    Raises
    ------
    BagError
        A folder cannot be read: bags in it would be missing without a word.
    """
    return [folder] if is_bag(folder) else sorted(_below(folder, without.resolve()))


def _below(folder: Path, without: Path) -> Iterator[Path]:
    for name, folders, files in os.walk(folder, onerror=_cannot_be_listed):
        place = Path(name)
        shown = [place / each for each in folders if not each.startswith(".")]
        inside = [each for each in shown if each.resolve() != without]
        bags = [each for each in inside if is_bag(each)]
        yield from bags
        folders[:] = [each.name for each in inside if each not in bags]
        yield from (place / each for each in files if not each.startswith(".") and _named(each))


def _named(name: str) -> bool:
    return Path(name).suffix.lower() in FILES


def _cannot_be_listed(error: OSError) -> NoReturn:
    _unreadable(Path(str(error.filename)), error)


def _unreadable(path: Path, error: OSError) -> NoReturn:
    why = error.strerror or error
    raise BagError(
        f"{path}: cannot be read: {why}; allow reading it, move it elsewhere, or list the drives "
        "in a manifest"
    ) from error

"""Tables of points in files, as headers declare them, and their bodies as text and as bytes.

Files are untrusted: what a header declares is compared with what the file holds before memory is
reserved for it, only x, y and z are taken out, and bodies are read in pieces of bounded size.
A `ValueError` says what is wrong with a file; `cloud.py` turns it into one line.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError

MAX_POINTS = 50_000_000
MAX_HEADER_BYTES = 1 << 16
MAX_LINE_BYTES = 1 << 13
PIECE_POINTS = 1 << 18
PIECE_BYTES = 1 << 26


@dataclass(frozen=True)
class Property:
    """A column of a table of points, ``repeat`` numbers wide."""

    name: str
    type: np.dtype[Any]
    repeat: int = 1

    @property
    def size(self) -> int:
        """Bytes in one record."""
        return self.type.itemsize * self.repeat


@dataclass(frozen=True)
class Table:
    """Records of the same properties, as a header declares them."""

    count: int
    properties: tuple[Property, ...]

    def __post_init__(self) -> None:
        if self.count < 0 or any(each.repeat < 0 for each in self.properties):
            raise ValueError("it declares a negative number")

    @property
    def size(self) -> int:
        """Bytes of one record."""
        return sum(each.size for each in self.properties)

    def columns(self) -> list[int]:
        """Return which numbers of a line of text are x, y and z."""
        repeats = [each.repeat for each in self.properties]
        return [sum(repeats[:at]) for at in self._places()]

    def view(self, data: bytes) -> list[npt.NDArray[Any]]:
        """Return x, y and z of whole records one after the other."""
        return [
            np.ndarray(len(data) // self.size, kind, data, offset, (self.size,))
            for kind, offset in self._axes()
        ]

    def view_by_property(self, data: bytearray) -> list[npt.NDArray[Any]]:
        """Return x, y and z of data that holds property after property of all records."""
        return [
            np.frombuffer(data, kind, self.count, offset * self.count)
            for kind, offset in self._axes()
        ]

    def _axes(self) -> list[tuple[np.dtype[Any], int]]:
        """Return the types of x, y and z and where they begin in a record, in bytes."""
        sizes = [each.size for each in self.properties]
        return [(self.properties[at].type, sum(sizes[:at])) for at in self._places()]

    def _places(self) -> list[int]:
        """Return which properties are x, y and z."""
        names = [each.name for each in self.properties]
        if any(names.count(axis) != 1 for axis in "xyz"):
            raise ValueError("it does not have the properties x, y and z, each once")
        places = [names.index(axis) for axis in "xyz"]
        if any(self.properties[at].repeat != 1 for at in places):
            raise ValueError("its x, y and z are not single numbers")
        return places


def header_words(file: IO[bytes]) -> Iterator[list[str]]:
    """Yield the words of the lines of a header that is not too long; `#` begins a comment."""
    while file.tell() < MAX_HEADER_BYTES and (line := file.readline(MAX_LINE_BYTES)):
        words = line.decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            yield words
    raise ValueError("its header has no end")


def text_pieces(file: IO[bytes], table: Table, skip: int = 0) -> Iterator[FloatArray]:
    """Yield the points of a table with one line of text for each, after ``skip`` other lines."""
    lines = islice(_filled_lines(file), skip, None)
    read = 0
    # loadtxt warns of no lines at all: the first of a piece is taken beforehand.
    while read < table.count and (first := next(lines, None)):
        rows = chain([first], islice(lines, min(PIECE_POINTS, table.count - read) - 1))
        piece = np.loadtxt(rows, usecols=table.columns(), comments=None, ndmin=2)
        read += len(piece)
        yield piece
    if read < table.count:
        raise ValueError(f"it declares {table.count} points and has {read}")


def _filled_lines(file: IO[bytes]) -> Iterator[bytes]:
    while line := file.readline(MAX_LINE_BYTES):
        if len(line) == MAX_LINE_BYTES:
            raise ValueError(f"it has a line of more than {MAX_LINE_BYTES} bytes")
        if not line.isspace():
            yield line


def binary_pieces(file: IO[bytes], table: Table) -> Iterator[FloatArray]:
    """Yield the points of a table that holds record after record.

    Raises
    ------
    ValueError
        The file is too short, or the records are not points.
    """
    require_bytes(remaining(file), table.count, table.size)
    step = max(1, PIECE_BYTES // max(1, table.size))
    for low in range(0, table.count, step):
        data = file.read(min(step, table.count - low) * table.size)
        yield stacked(table.view(data))


def stacked(columns: list[npt.NDArray[Any]]) -> FloatArray:
    """Return columns of any type as points, shape (N, 3)."""
    return np.column_stack([column.astype(np.float64) for column in columns])


def remaining(file: IO[bytes]) -> int:
    """Return the bytes from here to the end of a file."""
    return os.fstat(file.fileno()).st_size - file.tell()


def require_bytes(there: int, count: int, size: int) -> None:
    """Refuse a header that declares more than there is, before memory is reserved for it.

    Raises
    ------
    ValueError
        ``count`` times ``size`` bytes are more than ``there`` are.
    """
    if count * size > there:
        raise ValueError(f"it declares {count} x {size} bytes, {max(there, 0)} are there")


def refuse_many(path: Path, count: int) -> None:
    """Refuse a cloud that would fill the memory.

    Raises
    ------
    MapError
        More points are declared than are accepted.
    """
    if count > MAX_POINTS:
        raise MapError(
            f"{path}: declares {count} points, at most {MAX_POINTS} are accepted; thin the cloud "
            "with a voxel filter"
        )

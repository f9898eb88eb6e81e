"""Tables of points in files, as headers declare them, and their bodies: PLY and PCD.

PLY is the polygon file format 1.0; of PCD versions .5 to .7 are read, ascii, binary or
binary_compressed. Files are untrusted: what a header declares is compared with what the file holds
before memory is reserved for it, only x, y and z are taken out, and bodies are read in pieces of
bounded size. A `ValueError` says what is wrong with a file; `cloud.py` turns it into one line.
"""

import math
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.bounded import opened

MAX_POINTS = 50_000_000
ACCEPTED = "a .pcd, .ply, .las, .laz, .e57 or .npz file (of the array `points`, shape (N, 3))"
MISSING = f"no such point cloud; accepted: {ACCEPTED}"
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


CLASSIC = ["char", "uchar", "short", "ushort", "int", "uint", "float", "double"]
SIZED = ["int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
NUMPY = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
PLY_TYPES = dict(zip(CLASSIC + SIZED, NUMPY * 2, strict=True))
PLY_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


def ply_pieces(path: Path) -> Iterator[FloatArray]:
    """Yield the points of a PLY file, piece by piece, shape (N, 3).

    Raises
    ------
    MapError
        It declares too many points.
    ValueError
        It is damaged or another kind of file. So are KeyError (a type of number or order of
        bytes that is not known), IndexError (what ends too early) and OverflowError.
    """
    with opened(path, MapError, MISSING) as file:
        words = _ply_header(file)
        if words[0] != ["ply"] or words[1][0] != "format":
            raise ValueError("its first lines are not those of a PLY file")
        body = words[1][1]
        *before, table = _ply_tables(words[2:], PLY_ORDERS[body])
        refuse_many(path, table.count)
        if body == "ascii":
            yield from text_pieces(file, table, skip=sum(each.count for each in before))
        else:
            file.seek(sum(each.count * each.size for each in before), os.SEEK_CUR)
            yield from binary_pieces(file, table)


def _ply_header(file: IO[bytes]) -> list[list[str]]:
    header: list[list[str]] = []
    for words in header_words(file):
        if words[0] == "end_header":
            break
        if words[0] not in ("comment", "obj_info"):
            header.append(words)
    return header


def _ply_tables(header: list[list[str]], order: str) -> list[Table]:
    """Return the tables up to that of the vertices, which is the last; others do not matter."""
    starts = [line for line, words in enumerate(header) if words[0] == "element"]
    tables: list[Table] = []
    for low, high in pairwise([*starts, len(header)]):
        _, name, count = _three(header[low])
        properties = tuple(_ply_property(words, order) for words in header[low + 1 : high])
        tables.append(Table(int(count), properties))
        if name == "vertex":
            return tables
    raise ValueError("it has no element `vertex`")


def _ply_property(words: list[str], order: str) -> Property:
    if "list" in words[:2]:
        raise ValueError("its vertices have a list, or follow an element that has one")
    _, kind, name = _three(words)
    return Property(name, np.dtype(order + PLY_TYPES[kind]))


def _three(words: list[str]) -> list[str]:
    if len(words) != 3:
        raise ValueError(f"its header has a line {' '.join(words)!r}")
    return words


def write_ply(path: Path, points: FloatArray) -> None:
    """Write points, shape (N, 3), as binary float64."""
    axes = "".join(f"property double {axis}\n" for axis in "xyz")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}"
    with path.open("wb") as file:
        file.write(f"{header}end_header\n".encode("ascii"))
        file.write(np.ascontiguousarray(points, dtype="<f8").data)


PCD_TYPES = {"F4": "<f4", "F8": "<f8"} | {
    f"{sign}{size}": f"<{sign.lower()}{size}" for sign in "IU" for size in (1, 2, 4, 8)
}
MAX_UNPACKED_BYTES = 512 << 20


def pcd_pieces(path: Path) -> Iterator[FloatArray]:
    """Yield the points of a PCD file, piece by piece, shape (N, 3).

    Raises
    ------
    MapError
        It declares too many points.
    ValueError
        It is damaged or another kind of file. So are KeyError (what the header lacks),
        IndexError and struct.error (what ends too early).
    """
    with opened(path, MapError, MISSING) as file:
        header = _pcd_header(file)
        table = _pcd_table(header)
        refuse_many(path, table.count)
        body = header["DATA"][0].lower()
        if body not in PCD_BODIES:
            raise ValueError(f"its DATA is {body!r}, known are {', '.join(PCD_BODIES)}")
        yield from PCD_BODIES[body](file, table)


def _pcd_header(file: IO[bytes]) -> dict[str, list[str]]:
    header: dict[str, list[str]] = {}
    for words in header_words(file):
        header[words[0].upper()] = words[1:]
        if "DATA" in header:
            break
    return header


def _pcd_table(header: dict[str, list[str]]) -> Table:
    names, sizes, kinds = header["FIELDS"], header["SIZE"], header["TYPE"]
    repeats = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(repeats):
        raise ValueError("its FIELDS, SIZE, TYPE and COUNT are not of one length")
    properties = tuple(
        Property(name, np.dtype(PCD_TYPES[kind + size]), int(repeat))
        for name, size, kind, repeat in zip(names, sizes, kinds, repeats, strict=True)
    )
    extents = [header["POINTS"]] if "POINTS" in header else [header["WIDTH"], header["HEIGHT"]]
    return Table(math.prod(int(words[0]) for words in extents), properties)


def _packed_pieces(file: IO[bytes], table: Table) -> Iterator[FloatArray]:
    """Read what is packed property by property."""
    packed, size = struct.unpack("<II", file.read(8))
    require_bytes(remaining(file), packed, 1)
    if size > MAX_UNPACKED_BYTES:
        raise ValueError(f"it unpacks to {size} bytes, at most {MAX_UNPACKED_BYTES} are accepted")
    require_bytes(size, table.count, table.size)
    columns = table.view_by_property(_unpacked(file.read(packed), size))
    for low in range(0, table.count, PIECE_POINTS):
        yield stacked([column[low : low + PIECE_POINTS] for column in columns])


def _unpacked(packed: bytes, size: int) -> bytearray:
    """Undo LZF compression (liblzf): runs of literal bytes, and copies of what came before."""
    out, at = bytearray(), 0
    while at < len(packed) and len(out) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        distance = ((control & 31) << 8) + packed[at] + 1
        at += 1
        start = len(out) - distance
        if start < 0:
            raise ValueError("its packed data refers to what is not there")
        # A copy may reach into itself: what it repeats has the length of the distance.
        repeats = (length + 2) // distance + 1
        out += (out[start : start + length + 2] * repeats)[: length + 2]
    if len(out) != size:
        raise ValueError(f"its packed data does not hold the {size} bytes declared")
    return out


PCD_BODIES: dict[str, Callable[[IO[bytes], Table], Iterator[FloatArray]]] = {
    "ascii": text_pieces,
    "binary": binary_pieces,
    "binary_compressed": _packed_pieces,
}

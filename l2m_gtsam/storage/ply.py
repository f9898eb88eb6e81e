"""Points out of a PLY file (polygon file format 1.0), and into one."""

import os
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import IO

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.point_table import (
    Property,
    Table,
    binary_pieces,
    header_words,
    refuse_many,
    text_pieces,
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
    with path.open("rb") as file:
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
        raise ValueError("its vertices have a list, or stand behind an element that has one")
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

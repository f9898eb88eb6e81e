"""Points out of a PCD file, versions .5 to .7, ascii, binary or binary_compressed.

Sources: the PCD file format of the Point Cloud Library; the LZF stream format of liblzf.
"""

import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.point_table import (
    PIECE_POINTS,
    Property,
    Table,
    binary_pieces,
    header_words,
    refuse_many,
    remaining,
    require_bytes,
    stacked,
    text_pieces,
)

PCD_TYPES = {"F4": "<f4", "F8": "<f8"} | {
    f"{sign}{size}": f"<{sign.lower()}{size}" for sign in "IU" for size in (1, 2, 4, 8)
}
MAX_UNPACKED_BYTES = 2 << 30


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
    with path.open("rb") as file:
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

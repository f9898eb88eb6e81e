"""One entry of a tile store as a file: plain arrays, a version, a checksum, no pickle.

The file is the magic number, the length of the header as 8 bytes, a SHA-256 over all that follows
it, the header (JSON: fingerprint, and name, type and shape of each array) and the arrays, one after
the other in C order. All numbers are little-endian.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.tile_store import Arrays, Entry
from l2m_gtsam.storage.atomic import renamed_path

MAGIC = b"l2m-tile"
VERSION = 1
NUMBER_BYTES = 8
CHECKSUM_BYTES = hashlib.sha256().digest_size
START_BYTES = len(MAGIC) + 2 * NUMBER_BYTES + CHECKSUM_BYTES
MOST_BYTES, MOST_HEADER_BYTES = 1 << 28, 1 << 16
DTYPES = {each.str: each for each in (np.dtype("<f8"), np.dtype("<i8"))}


def write_tile(path: Path, entry: Entry, arrays: Arrays) -> int:
    """Write an entry, and return its size in bytes.

    It is not forced to the disk: what a power cut leaves of it does not have its checksum.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    facts = {
        "fingerprint": entry.fingerprint,
        "arrays": [[name, each.dtype.str, each.shape] for name, each in plain.items()],
    }
    header = json.dumps(facts).encode()
    digest = hashlib.sha256(header)
    for each in plain.values():
        digest.update(each.reshape(-1).view(np.uint8).data)
    with renamed_path(path) as temporary, temporary.open("wb") as file:
        file.write(MAGIC + _number(VERSION) + _number(len(header)) + digest.digest() + header)
        for each in plain.values():
            file.write(each.reshape(-1).view(np.uint8).data)
        return file.tell()


def read_tile(path: Path, entry: Entry) -> Arrays:
    """Return the arrays of an entry.

    Raises
    ------
    MapError
        The file is another entry, of another version, or damaged.
    OSError
        It cannot be read.
    """
    with path.open("rb") as file:
        left = os.fstat(file.fileno()).st_size
        checksum, header = _read_start(file, left)
        facts = _facts(header)
        if facts["fingerprint"] != entry.fingerprint:
            raise MapError("it is of another map or of another version of the program")
        digest = hashlib.sha256(header)
        arrays = _empty_arrays(facts, left - file.tell())
        for array in arrays.values():
            content = array.reshape(-1).view(np.uint8)
            if file.readinto(content.data) != len(content):
                raise MapError("it is cut short")
            digest.update(content.data)
    if digest.digest() != checksum:
        raise MapError("its checksum does not match")
    return arrays


def fingerprint_of(path: Path) -> str | None:
    """Return the fingerprint that a file claims to have; None if it has none."""
    try:
        with path.open("rb") as file:
            _, header = _read_start(file, os.fstat(file.fileno()).st_size)
            return str(_facts(header)["fingerprint"])
    except (MapError, OSError):
        return None


def _read_start(file: IO[bytes], size: int) -> tuple[bytes, bytes]:
    """Return checksum and header of a file of so many bytes."""
    start = file.read(START_BYTES)
    if len(start) < START_BYTES or not start.startswith(MAGIC):
        raise MapError("it is cut short or no tile")
    at = len(MAGIC)
    version, length = (
        int.from_bytes(start[at + k * NUMBER_BYTES : at + (k + 1) * NUMBER_BYTES], "little")
        for k in (0, 1)
    )
    if version != VERSION:
        raise MapError(f"it is of version {version}, not {VERSION}")
    if size > MOST_BYTES or length > min(MOST_HEADER_BYTES, size - START_BYTES):
        raise MapError("it is cut short or too large")
    return start[-CHECKSUM_BYTES:], file.read(length)


def _facts(header: bytes) -> dict[str, Any]:
    try:
        facts = json.loads(header)
    except (ValueError, RecursionError):
        raise MapError("its header is damaged") from None
    if not isinstance(facts, dict) or not {"fingerprint", "arrays"} <= set(facts):
        raise MapError("its header is damaged")
    return facts


def _empty_arrays(facts: dict[str, Any], left: int) -> dict[str, npt.NDArray[Any]]:
    """Return arrays to fill, if they take just the bytes that are left."""
    shapes = {}
    try:
        for name, kind, shape in facts["arrays"]:
            shapes[str(name)] = DTYPES[kind], tuple(int(length) for length in shape)
    except (TypeError, ValueError, KeyError, OverflowError):
        raise MapError("its header is damaged") from None
    declared = 0
    for dtype, shape in shapes.values():
        count = dtype.itemsize
        for length in shape:
            if length < 0:
                raise MapError("its header is damaged")
            count *= length
        declared += count
    if declared != left:
        raise MapError("it is cut short or too long")
    try:
        return {name: np.empty(shape, dtype) for name, (dtype, shape) in shapes.items()}
    except (ValueError, OverflowError):  # too many axes, or too long a one beside one of none
        raise MapError("its header is damaged") from None


def _number(value: int) -> bytes:
    return value.to_bytes(NUMBER_BYTES, "little")

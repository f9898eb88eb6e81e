"""Bounds for rosbags, which unpacks and parses what a bag declares without a limit.

A chunk of some kilobytes may unpack to gigabytes, in any of the containers and compressions. The
places where rosbags unpacks chunks and files, reads records and parses YAML are taken by functions
of this module, for this process; `tests/unit/storage/test_rosbags_bounds.py` finds a release of
rosbags in which one of them has another name.
"""

import bz2
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import Any, BinaryIO

import lz4.frame
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.rosbag2 import metadata as ros2_metadata
from rosbags.rosbag2 import reader as ros2
from rosbags.rosbag2 import storage_mcap, storage_sqlite3

from l2m_gtsam.storage.yaml_file import BoundedYAML

MEBIBYTE = 1 << 20
# Recorders close a chunk at some megabytes; one message, a scan or a picture, may be larger.
MOST_CHUNK = 256 * MEBIBYTE
# Chunks that overlap in time are held together.
MOST_TOGETHER = 384 * MEBIBYTE
# A bag that is compressed as a whole is unpacked into a temporary file.
MOST_UNPACKED = 64 * 1024 * MEBIBYTE
# Unpacked at once: a decompressor's own buffer may be as large again, and is copied as it grows.
MOST_AT_ONCE = 32 * MEBIBYTE
MOST_DEFINITION = 200_000  # letters; those of ROS with all that they hold are under 20,000
MOST_SEQUENCE = MOST_CHUNK  # of bytes, that is
MOST_REPEATED = 1000  # of a message type in another one
PIECE = 1 << 16
SQLITE_LIMIT_LENGTH = 0  # its number in SQLite's interface
ZSTD: Any = vars(ros2)["zstd"]  # before it is replaced below
WINDOW = {ZSTD.DecompressionParameter.window_log_max: 27}  # 128 MiB; the default of its program


class UnpackingError(Exception):
    """Something in a bag that is larger than any recorder makes it."""


def unpack_bz2(data: bytes) -> bytes:
    """Return what a chunk of bz2 holds; an UnpackingError if that is too much."""
    return _unpacked(bz2.BZ2Decompressor, data, MOST_CHUNK)


def unpack_lz4(data: bytes, size: int = MOST_CHUNK) -> bytes:
    """Return what a chunk of lz4 holds; an UnpackingError if it is more than ``size`` bytes."""
    return _unpacked(lz4.frame.LZ4FrameDecompressor, data, size)


def unpack_zstd(data: bytes, size: int = MOST_CHUNK) -> bytes:
    """Return what a chunk of zstd holds; an UnpackingError if it is more than ``size`` bytes."""
    return _unpacked(partial(ZSTD.ZstdDecompressor, options=WINDOW), data, size)


def _unpacked(make: Callable[[], Any], data: bytes, size: int) -> bytes:
    """Return what frames, one after the other, hold together."""
    most, parts = min(size, MOST_CHUNK), []
    while True:
        decompressor = make()
        while not decompressor.eof:
            part = decompressor.decompress(data, MOST_AT_ONCE)
            if not part and not decompressor.eof:
                raise UnpackingError("a compressed chunk ends too early")
            data = b""  # the decompressor has it
            parts.append(part)
            most -= len(part)
            if most < 0:
                raise UnpackingError(
                    f"a chunk unpacks to more than the {min(size, MOST_CHUNK):,} bytes that are "
                    "declared or accepted"
                )
        data = decompressor.unused_data
        if not data:
            return parts[0] if len(parts) == 1 else b"".join(parts)


def _read(source: BinaryIO, size: int, check: str) -> bytes:
    if size > MOST_CHUNK:
        raise UnpackingError(f"declares a record of {size:,} bytes; at most {MOST_CHUNK:,}")
    found = source.read(size)
    if len(found) != size:
        raise UnpackingError(f"{check}: {size} bytes expected, {len(found)} are there")
    return found


def _read_ros1(source: BinaryIO, size: int) -> bytes:
    return _read(source, size, "record is cut short")


def _read_mcap(source: BinaryIO, size: int) -> bytes:
    return _read(source, size, f"record at {source.tell()} is cut short")


class _BoundedZstd:
    """What rosbags uses of zstd: messages and files that are compressed by themselves."""

    decompress = staticmethod(unpack_zstd)

    @staticmethod
    @contextmanager
    def open(file: BinaryIO, mode: str) -> Iterator[io.RawIOBase]:
        """Give what a compressed file holds, as far as ``MOST_UNPACKED``."""
        with ZSTD.open(file, mode) as inner:
            yield _Counted(inner)


class _Counted(io.RawIOBase):
    """A file that ends with an error after too many bytes."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._left = file, MOST_UNPACKED

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes."""
        found = self._file.read(size if size > 0 else PIECE)
        self._left -= len(found)
        if self._left < 0:
            raise UnpackingError(f"unpacks to more than {MOST_UNPACKED / 2**30:.0f} GiB")
        return found


REPLACED: tuple[tuple[ModuleType, str, Any], ...] = (
    (ros1, "read_bytes", _read_ros1),
    (storage_mcap, "read_exact", _read_mcap),
    (ros2, "zstd", _BoundedZstd()),
    (ros2, "YAML", BoundedYAML),
    (ros2_metadata, "YAML", BoundedYAML),
)
UNPACKERS: tuple[tuple[dict[str, Any], str, Any], ...] = (
    (ros1.decompressors, "bz2", unpack_bz2),
    (ros1.decompressors, "lz4", unpack_lz4),
    (storage_mcap.DECOMPRESSORS, "lz4", unpack_lz4),
    (storage_mcap.DECOMPRESSORS, "zstd", unpack_zstd),
)


def bound_rosbags() -> None:
    """Put the functions of this module in their places; again changes nothing."""
    for module, name, function in REPLACED:
        setattr(module, name, function)
    for table, name, function in UNPACKERS:
        table[name] = function


def check_sizes(reader: Ros1Reader | Ros2Reader) -> None:
    """Raise an UnpackingError for an open bag whose index declares what cannot be held."""
    if isinstance(reader, Ros1Reader):
        _check_chunks([chunk.datasize for chunk in reader.chunks.values()])
        return
    for storage in storages(reader):
        if isinstance(storage, storage_mcap.McapReader):
            _check_chunks([chunk.uncompressed_size for chunk in storage.chunks])
            _check_overlap(storage.chunks)
        elif isinstance(storage, storage_sqlite3.Sqlite3Reader) and storage.dbconn is not None:
            storage.dbconn.limit(SQLITE_LIMIT_LENGTH, MOST_CHUNK)


def check_names(reader: Ros1Reader | Ros2Reader) -> None:
    """Raise an UnpackingError for an open bag whose topics or types are no text, but numbers."""
    for each in reader.connections:
        for name in (each.topic, each.msgtype, each.msgdef.data):
            if not isinstance(name, str):
                raise UnpackingError(f"names a topic or its type {name!r:.40}, which is no text")


def storages(reader: Ros2Reader) -> list[Any]:
    """Return what reads the files of a bag: a folder has several."""
    return getattr(reader.storage, "storages", None) or [reader.storage]


def _check_chunks(sizes: Sequence[int]) -> None:
    largest = max(sizes, default=0)
    if largest > MOST_CHUNK:
        raise UnpackingError(
            f"declares a chunk of {largest:,} bytes; at most {MOST_CHUNK:,} are accepted"
        )


def _check_overlap(chunks: Iterable[Any]) -> None:
    """Refuse chunks that would be unpacked at the same time, because their times overlap."""
    ends = [
        end
        for chunk in chunks
        for end in (
            (chunk.message_start_time, 0, chunk.uncompressed_size),
            (chunk.message_end_time, 1, -chunk.uncompressed_size),
        )
    ]
    held = 0
    for _, _, size in sorted(ends):
        held += size
        if held > MOST_TOGETHER:
            raise UnpackingError(
                f"has chunks of more than {MOST_TOGETHER:,} bytes that overlap in time; write it "
                "again in order of time"
            )


def check_definition(types: dict[str, Any]) -> None:
    """Raise a ValueError for parsed types of which a few bytes could decode to very much."""
    empty = {name for name, (_, fields) in types.items() if not fields}
    for name, (_, fields) in types.items():
        for field, (kind, description) in fields:
            if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                continue
            (inner, inner_name), count = description
            if inner is Nodetype.NAME and inner_name in empty:
                raise ValueError(f"{name}.{field} repeats a type without content")
            is_number = inner is Nodetype.BASE and inner_name[0] != "string"
            if kind is Nodetype.ARRAY and not is_number and count > MOST_REPEATED:
                raise ValueError(f"{name}.{field} repeats {inner_name} {count} times")

"""Arrays in zip archives, read within bounds and without pickle: maps and clouds as ``.npz``."""

import struct
import zipfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from l2m_gtsam.errors import L2MError
from l2m_gtsam.storage.bounded import opened

# The end of an archive: its signature, eight bytes, then the size of its directory.
END, END_BYTES, LONGEST_COMMENT = b"PK\x05\x06", 22, 1 << 16
MOST_DIRECTORY = 1 << 20  # of thousands of members
PIECE = 1 << 24


class ArchiveError(ValueError):
    """An archive, or an array in it, that is not what it should be."""


@dataclass(frozen=True)
class ArrayMember:
    """An array in an archive, whose header was read.

    Attributes
    ----------
    file
        Its numbers.
    shape, dtype, fortran
        What the header declares.
    size
        Bytes of numbers, as the archive declares.
    """

    file: IO[bytes]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool
    size: int


@contextmanager
def open_archive(
    path: Path, error: type[L2MError], missing: str, kinds: Collection[int]
) -> Iterator[zipfile.ZipFile]:
    """Open an archive.

    Parameters
    ----------
    path, error, missing
        As in ``bounded.opened``.
    kinds
        Compressions that are accepted, as ``zipfile`` numbers them.

    Raises
    ------
    L2MError
        Of the kind given: it cannot be opened.
    ArchiveError
        It is no archive, is damaged, or is compressed in another way.
    """
    with opened(path, error, missing) as file:
        _check_end(file)
        with _translated():
            archive = zipfile.ZipFile(file)
        with archive:
            for info in archive.infolist():
                if info.compress_type not in kinds:
                    raise ArchiveError(f"its member {info.filename!r} is compressed unusually")
            yield archive


def read_stored_array(archive: zipfile.ZipFile, name: str, kinds: str) -> npt.NDArray[Any]:
    """Return an array that is as large as the archive says, read into its memory at once.

    Parameters
    ----------
    archive
        Open.
    name
        Of the member.
    kinds
        Of numbers that are accepted, as numpy names them.

    Raises
    ------
    ArchiveError
        It is missing or damaged.
    """
    with opened_array(archive, name) as member:
        foreign = member.fortran or member.dtype.kind not in kinds
        if foreign or bytes_of(member.shape, member.dtype) != member.size:
            raise ArchiveError(f"array {name!r} is not what it declares to be")
        found, filled = np.empty(member.size, dtype=np.uint8), 0
        while piece := member.file.read(min(PIECE, member.size - filled)):
            found[filled : filled + len(piece)] = np.frombuffer(piece, dtype=np.uint8)
            filled += len(piece)
        if filled < member.size or member.file.read(1):
            raise ArchiveError(f"array {name!r} is not as long as it declares to be")
        return found.view(member.dtype).reshape(member.shape)


@contextmanager
def opened_array(archive: zipfile.ZipFile, name: str) -> Iterator[ArrayMember]:
    """Give an array whose header was read, and its numbers to be read.

    Raises
    ------
    ArchiveError
        The member is missing or damaged.
    """
    with _translated(), archive.open(name) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ArchiveError("an array is of an unknown version")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
        size = archive.getinfo(name).file_size - file.tell()
        yield ArrayMember(file, shape, dtype, fortran and len(shape) > 1, size)


def bytes_of(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Return the size that a shape needs, in whole numbers that cannot overflow."""
    size = dtype.itemsize
    for length in shape:
        size *= length
    return size


def _check_end(file: BinaryIO) -> None:
    """Refuse an archive whose directory alone would fill the memory."""
    size = file.seek(0, 2)
    file.seek(max(0, size - END_BYTES - LONGEST_COMMENT))
    tail = file.read()
    at = tail.rfind(END)
    if at < 0 or len(tail) - at < END_BYTES:
        raise ArchiveError("it is no archive, or is cut short")
    (directory,) = struct.unpack_from("<I", tail, at + 12)
    if directory > MOST_DIRECTORY:
        raise ArchiveError(f"its directory takes {directory} bytes, or is of a large archive")
    file.seek(0)


@contextmanager
def _translated() -> Iterator[None]:
    try:
        yield
    except (L2MError, ArchiveError, OSError, MemoryError):
        raise
    except Exception as reason:  # of zip, numpy and unpackers on bad files: dozens of kinds
        raise ArchiveError(" ".join(str(reason).split())[:200] or type(reason).__name__) from reason

"""Files that are read within bounds: regular ones only, and no more bytes than are expected.

All readers open files here, or have them checked here where a library opens them. A pipe or a
device would be waited for, or be read until the memory is full. Maps and clouds are arrays in zip
archives (``.npz``), read without pickle.
"""

import errno
import os
import stat
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
import numpy.typing as npt

from l2m_gtsam.errors import L2MError
from l2m_gtsam.text import shown

MEGABYTE = 1_000_000
# The end of an archive: its signature, eight bytes, then the size of its directory.
END, END_BYTES, LONGEST_COMMENT = b"PK\x05\x06", 22, 1 << 16
# A bomb is refused for the size that it declares, or for its checksum.
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Booleans, integers, unsigned, floating and complex numbers; anything else could hide objects.
NUMERIC = "biufc"
MOST_DIRECTORY = 1 << 20  # of thousands of members
PIECE = 1 << 24
MOST_NAMES = 6  # in a message


@contextmanager
def opened(
    path: Path, error: type[L2MError] = L2MError, missing: str = "no such file"
) -> Iterator[BinaryIO]:
    """Open a regular file for reading bytes.

    Parameters
    ----------
    path
        The file, or a link to one.
    error
        What to raise.
    missing
        What is said of a file that is not there.

    Raises
    ------
    L2MError
        Of the kind given: it is missing, is a folder, a pipe or a device, or cannot be opened or
        read.
    """
    try:
        file = open_regular(path)
    except (OSError, ValueError) as reason:
        raise error(f"{path}: {_why(reason, missing)}") from reason
    with file:
        try:
            yield file
        except OSError as reason:
            raise error(f"{path}: {_why(reason, missing)}") from reason


def open_regular(path: Path) -> BufferedReader:
    """Return a regular file, opened for reading bytes.

    Raises
    ------
    OSError
        It is missing, is a folder, a pipe or a device, or cannot be opened.
    ValueError
        There can be no such name.
    """
    # Without waiting: a pipe would be waited for until somebody writes to it.
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(handle).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(handle, "rb")
    os.close(handle)
    wanted = f"a regular file is expected{_files_in(path) if stat.S_ISDIR(mode) else ''}"
    raise OSError(errno.EINVAL, f"{_kind(mode)}; {wanted}", str(path))


def read_content(
    path: Path, most_bytes: int, error: type[L2MError] = L2MError, missing: str = "no such file"
) -> bytes:
    """Return the bytes of a regular file.

    Parameters
    ----------
    path, error, missing
        As in ``opened``.
    most_bytes
        How large it may be.

    Raises
    ------
    L2MError
        As in ``opened``, or the file is larger.
    """
    with opened(path, error, missing) as file:
        found = file.read(most_bytes + 1)  # files of the system have no size beforehand
    if len(found) > most_bytes:
        most = f"{most_bytes / MEGABYTE:g} MB"
        raise error(f"{path}: larger than {most}, which no file of the kind expected here is")
    return found


def require_regular(
    path: Path, error: type[L2MError] = L2MError, missing: str = "no such file"
) -> None:
    """Raise an error as ``opened`` does, for files that a library opens."""
    with opened(path, error, missing):
        pass


def is_there(path: Path, error: type[L2MError] = L2MError) -> bool:
    """Return whether there is anything under a name; an error for names that there cannot be."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError) as reason:
        raise error(f"{path}: {_why(reason, '')}") from reason
    return True


def _why(reason: Exception, missing: str) -> str:
    if isinstance(reason, FileNotFoundError):
        return missing
    return f"cannot be read: {getattr(reason, 'strerror', None) or reason}"


def _files_in(folder: Path) -> str:
    """Return what could be given instead of a folder, as the end of a sentence."""
    try:
        names = sorted(each.name for each in folder.iterdir() if not each.name.startswith("."))
    except OSError:
        return ""
    more = ["..."] if len(names) > MOST_NAMES else []
    return f"; in it: {', '.join([*map(shown, names[:MOST_NAMES]), *more])}" if names else ""


def _kind(mode: int) -> str:
    kinds = {
        stat.S_ISDIR: "a folder",
        stat.S_ISFIFO: "a pipe",
        stat.S_ISCHR: "a device",
        stat.S_ISBLK: "a device",
        stat.S_ISSOCK: "a socket",
    }
    return "is " + next((name for test, name in kinds.items() if test(mode)), "of no known kind")


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
def open_archive(path: Path, error: type[L2MError], missing: str) -> Iterator[zipfile.ZipFile]:
    """Open an archive.

    Parameters
    ----------
    path, error, missing
        As in ``bounded.opened``.

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
                if info.compress_type not in COMPRESSIONS:
                    raise ArchiveError(f"its member {info.filename!r} is compressed unusually")
            yield archive


def read_stored_array(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    """Return an array that is as large as the archive says, read into its memory at once.

    Parameters
    ----------
    archive
        Open.
    name
        Of the member.

    Raises
    ------
    ArchiveError
        It is missing or damaged.
    """
    with opened_array(archive, name) as member:
        foreign = member.fortran or member.dtype.kind not in NUMERIC
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

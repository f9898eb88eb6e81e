"""Files that are read within bounds: regular ones only, and no more bytes than are expected.

All readers open files here, or have them checked here where a library opens them. A pipe or a
device would be waited for, or be read until the memory is full.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

from l2m_gtsam.errors import L2MError

MEGABYTE = 1_000_000


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
    raise OSError(errno.EINVAL, f"{_kind(mode)}; a regular file is expected", str(path))


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


def _kind(mode: int) -> str:
    kinds = {
        stat.S_ISDIR: "a folder",
        stat.S_ISFIFO: "a pipe",
        stat.S_ISCHR: "a device",
        stat.S_ISBLK: "a device",
        stat.S_ISSOCK: "a socket",
    }
    return "is " + next((name for test, name in kinds.items() if test(mode)), "of no known kind")

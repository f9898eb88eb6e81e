"""What is being written: hidden, held by whoever writes it, and swept when nobody does.

A file or folder gets its name when it is complete. Until then it is a part, `.name.1a2b3c4d.part`,
beside it. A part of a run that was killed stays; the next run that writes under the same name
removes it, unless somebody holds it.
"""

import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep

from l2m_gtsam.errors import OutputError

SUFFIX = ".part"
TRIES = 10  # a sweeper may take a part in the moment before it is held
LOOK_AGAIN_S = 0.05
_OURS: set[tuple[int, int]] = set()  # folders that this process holds


@contextmanager
def part_file(path: Path) -> Iterator[Path]:
    """Give an empty hidden file beside a name; it is removed at the end unless it was renamed.

    Raises
    ------
    OSError
        It cannot be made.
    """

    def make(part: Path) -> int:
        return os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o666)

    part, handle = _held(path, make)
    try:
        yield part
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def part_folder(path: Path) -> Iterator[Path]:
    """Give an empty hidden folder beside a name; what is left of it at the end is removed.

    Raises
    ------
    OSError
        It cannot be made.
    """

    def make(part: Path) -> int:
        part.mkdir()
        return os.open(part, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)

    part, handle = _held(path, make)
    _OURS.add(which := _identity(handle))
    try:
        yield part
    finally:
        _OURS.discard(which)
        shutil.rmtree(part, ignore_errors=True)
        os.close(handle)


def sweep(path: Path) -> None:
    """Remove the parts of a name that nobody holds."""
    start, digits = f".{path.name}.", re.compile("[0-9a-f]{8}")
    with suppress(OSError), os.scandir(path.parent) as files:
        for each in files:  # no path of each: a folder may have thousands of files
            name = each.name
            if not (name.startswith(start) and name.endswith(SUFFIX)):
                continue
            if digits.fullmatch(name[len(start) : -len(SUFFIX)]):
                _remove_unheld(path.parent / name)


@contextmanager
def only_one(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Hold a folder, so that no other run writes its results there at the same time.

    Parameters
    ----------
    folder
        That exists.
    wait_s
        How long to wait for another one.

    Raises
    ------
    OutputError
        Another run holds it, in another process.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    which = _identity(handle)
    if which in _OURS:
        os.close(handle)
        yield
        return
    try:
        late = monotonic() + wait_s
        while not _hold(handle):
            if monotonic() >= late:
                raise OutputError(
                    f"{folder}: another run is writing its results there; wait for it, or choose "
                    "another --out"
                )
            sleep(LOOK_AGAIN_S)
        _OURS.add(which)
        yield
    finally:
        _OURS.discard(which)
        os.close(handle)


def _identity(handle: int) -> tuple[int, int]:
    state = os.fstat(handle)
    return state.st_dev, state.st_ino


def _held(path: Path, make: Callable[[Path], int]) -> tuple[Path, int]:
    """Return a new part and the handle that holds it, after unheld ones were removed."""
    sweep(path)
    for _ in range(TRIES):
        part = path.with_name(f".{path.name}.{secrets.token_hex(4)}{SUFFIX}")
        handle = make(part)
        if _hold(handle) and _is_still(part, handle):
            return part, handle
        os.close(handle)
    raise OSError(f"{part} is taken away by another run again and again")


def _hold(handle: int) -> bool:
    """Return whether a file is held now, or file systems there know of no holding."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True


def _is_still(part: Path, handle: int) -> bool:
    try:
        return os.path.samestat(part.lstat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _remove_unheld(part: Path) -> None:
    """Remove a part unless somebody holds it, or it cannot be known."""
    try:
        handle = os.open(part, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
        else:
            part.unlink(missing_ok=True)
    except OSError:
        pass
    finally:
        os.close(handle)

"""Files of any kind: written whole or not at all, their digests, and safe names for folders."""

import errno
import hashlib
import os
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import TextIO

from l2m_gtsam.data import SourceFile
from l2m_gtsam.errors import L2MError, NoRoomError, OutputError
from l2m_gtsam.storage.bounded import open_regular, opened
from l2m_gtsam.storage.parts import part_file

MAX_TEXT_BYTES = 500_000_000  # a day of poses at 50 Hz


@contextmanager
def open_text(path: Path, error: type[L2MError]) -> Iterator[TextIO]:
    """Open a text of others for reading, line by line.

    Parameters
    ----------
    path
        A regular file in UTF-8.
    error
        What to raise, with one line that names the file, if it cannot be read.
    """
    with opened(path, error) as file:
        if os.fstat(file.fileno()).st_size > MAX_TEXT_BYTES:
            raise error(f"{path}: larger than {MAX_TEXT_BYTES // 1_000_000} MB; give a shorter one")
        try:
            yield TextIOWrapper(file, encoding="utf-8-sig", newline="")
        except UnicodeDecodeError as reason:
            raise error(f"{path}: cannot be read: it is no text") from reason


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary file to write, and rename it to ``path`` when the block ends well.

    The temporary file is in the same folder, so that the rename is one step of the file
    system. When the block fails it is removed, and what was under ``path`` before stays.

    Parameters
    ----------
    path
        Name that the complete file gets.

    Yields
    ------
    Path
        An empty file to write to.

    Raises
    ------
    OutputError
        The folder is missing or the file cannot be written.
    """
    with renamed_path(path) as temporary:
        yield temporary
        flush(temporary)


@contextmanager
def renamed_path(path: Path) -> Iterator[Path]:
    """Give a temporary file as ``atomic_path`` does, for what may be lost with the power.

    Half of it may then be under the name; whoever reads it has to notice.
    """
    if path.exists() and not path.is_file():
        raise OutputError(f"{path}: cannot be written: it exists and is not a regular file")
    try:
        with part_file(path) as temporary:
            yield temporary
            temporary.replace(path)
    except OSError as error:
        raise unwritten(path, error) from error


NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


def unwritten(path: Path, error: OSError, what: str = "cannot be written") -> OutputError:
    """Return what to raise for a result that cannot be written: an error of its own without room.

    Parameters
    ----------
    path
        The result.
    error
        Why.
    what
        What cannot be done.
    """
    line = f"{path}: {what}: {error.strerror or error}"
    if error.errno in NO_ROOM:
        return NoRoomError(f"{line}; make room, and run it again")
    return OutputError(line)


def ensure_folder(folder: Path) -> None:
    """Make a folder for results, and those above it, unless it is there; an OutputError if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritten(folder, error, "cannot be made as a folder for results") from error


def flush(path: Path) -> None:
    """Have what a file or a folder holds on the disk, before a name points to it."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: Path, text: str) -> None:
    """Write a text, whole or not at all; what no file can hold of it is replaced."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace")


def source_file(path: Path) -> SourceFile:
    """Return the SHA-256 of a file, or of all files in a folder.

    A file's digest is that of ``sha256sum``. A folder's is taken over its files in order of their
    names relative to it: the name, a zero byte, the size as text, a zero byte, the content.

    Parameters
    ----------
    path
        File, or folder (a ROS2 bag).

    Raises
    ------
    L2MError
        The path does not exist or cannot be read.
    """
    digest = hashlib.sha256()
    try:
        for head, file in _hashed(path):
            digest.update(head)
            with open_regular(file) as content:
                hashlib.file_digest(content, lambda: digest)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise L2MError(f"{path}: cannot be read: {reason}") from error
    return SourceFile(str(path), digest.hexdigest())


def _hashed(path: Path) -> Iterator[tuple[bytes, Path]]:
    """Yield a file, or those in a folder, with what is hashed before the content of each."""
    if not path.is_dir():
        yield b"", path
        return
    files = {file.relative_to(path).as_posix(): file for file in path.rglob("*")}
    for name, file in sorted(files.items()):
        if file.is_file():
            yield f"{name}\0{file.stat().st_size}\0".encode(), file


LONGEST = 60  # letters: four bytes each and a digest are still a name for every file system
DIGITS = 8  # of the digest that makes names differ
PLAIN = "._-+ "  # beside letters and digits


def folder_names(
    names: Sequence[str], identities: Sequence[str], reserved: Sequence[str] = ()
) -> list[str]:
    """Return a folder's name for each of these names, no two alike on any file system.

    A name that is one already stays as it is. Any other, and all of those that are alike but for
    upper and lower case, get a few digits of a digest. So a name does not
    depend on the order of all, and on others only when they are like it: one that had no digits
    gets them when another like it is added.

    Parameters
    ----------
    names
        Any text.
    identities
        What each name is of, unique.
    reserved
        Names that are taken.
    """
    safe = [_safe(name) for name in names]
    taken = Counter(map(_alike, safe)) + Counter({_alike(name): 1 for name in reserved})
    return [
        made if made == name and taken[_alike(made)] == 1 else f"{made}-{_digits(identity)}"
        for name, made, identity in zip(names, safe, identities, strict=True)
    ]


def printable(text: str) -> str:
    """Return text that can be written and shown anywhere: without control characters."""
    encodable = text.encode("utf-8", "replace").decode("utf-8")
    return "".join("\N{REPLACEMENT CHARACTER}" if _controls(each) else each for each in encodable)


def _safe(name: str) -> str:
    letters = (each if each.isalnum() or each in PLAIN else "_" for each in name)
    return "".join(letters)[:LONGEST].lstrip(". -").rstrip(". ") or "_"


def _alike(name: str) -> str:
    return unicodedata.normalize("NFKC", name).casefold()


def _digits(identity: str) -> str:
    return hashlib.sha256(identity.encode(errors="surrogatepass")).hexdigest()[:DIGITS]


def _controls(letter: str) -> bool:
    """Return whether a letter is a control character, or changes the direction of others."""
    return unicodedata.category(letter) in ("Cc", "Cf", "Zl", "Zp")

"""The content of a file or folder as one number."""

import hashlib
from pathlib import Path
from typing import Protocol

from l2m_gtsam.data import SourceFile
from l2m_gtsam.errors import L2MError

CHUNK_BYTES = 1 << 20


class Hasher(Protocol):
    """What takes in bytes."""

    def update(self, data: bytes, /) -> None:
        """Take in bytes."""


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
        if path.is_dir():
            _take_folder(digest, path)
        else:
            _take_file(digest, path)
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror or error}"
        raise L2MError(msg) from error
    return SourceFile(str(path), digest.hexdigest())


def _take_folder(digest: Hasher, folder: Path) -> None:
    files = {file.relative_to(folder).as_posix(): file for file in folder.rglob("*")}
    for name, file in sorted(files.items()):
        if file.is_file():
            digest.update(f"{name}\0{file.stat().st_size}\0".encode())
            _take_file(digest, file)


def _take_file(digest: Hasher, path: Path) -> None:
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            digest.update(chunk)

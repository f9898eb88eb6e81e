"""Where data came from, as a name and a hash."""

import hashlib
from pathlib import Path

from l2m_gtsam.data import SourceFile

CHUNK = 1 << 20


def source_file(path: Path) -> SourceFile:
    """Return the path with the SHA-256 of the file, or of a folder's files in order of name."""
    digest = hashlib.sha256()
    if path.is_dir():
        for file in sorted(each for each in path.rglob("*") if each.is_file()):
            digest.update(file.relative_to(path).as_posix().encode() + b"\0")
            _feed(digest, file)
    else:
        _feed(digest, path)
    return SourceFile(str(path), digest.hexdigest())


def _feed(digest: "hashlib._Hash", file: Path) -> None:
    with file.open("rb") as stream:
        while chunk := stream.read(CHUNK):
            digest.update(chunk)

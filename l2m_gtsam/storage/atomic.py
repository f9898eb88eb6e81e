"""Files appear under their name when they are complete, or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from l2m_gtsam.errors import OutputError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary file to write, and rename it to ``path`` when the block ends well.

    The temporary file stands in the same folder, so that the rename is one step of the file
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
        _flush(temporary)


@contextmanager
def renamed_path(path: Path) -> Iterator[Path]:
    """Give a temporary file as ``atomic_path`` does, for what may be lost with the power.

    Half of it may then be under the name; whoever reads it has to notice.
    """
    if path.exists() and not path.is_file():
        msg = f"{path}: cannot be written: it exists and is not a regular file"
        raise OutputError(msg)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror or error}"
        raise OutputError(msg) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Have the content on the disk before the name points to it."""
    with path.open("rb") as file:
        os.fsync(file.fileno())

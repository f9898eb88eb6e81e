"""Places where results go."""

from pathlib import Path

from l2m_gtsam.errors import OutputError


def check_outputs(*files: Path, suffix: str | None = None) -> None:
    """Raise an OutputError, before any work is done, for files that cannot be written."""
    for file in files:
        if suffix is not None and file.suffix != suffix:
            raise OutputError(f"{file}: the name must end in {suffix}")
        if file.exists() and not file.is_file():
            raise OutputError(f"{file}: exists and is not a regular file; choose another --out")
        if file.parent.exists() and not file.parent.is_dir():
            raise OutputError(f"{file.parent}: is a file, --out needs a folder; choose another")


def ensure_folder(folder: Path) -> None:
    """Make a folder for results, and those above it, unless it is there; an OutputError if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        msg = f"{folder}: cannot be made as a folder for results: {error.strerror}"
        raise OutputError(msg) from error

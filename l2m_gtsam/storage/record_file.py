"""Files of one record that this program writes as JSON: read without trust."""

from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import CalibrationError

MAX_BYTES = 100_000_000  # figures of a hundred sensors are some megabytes
Content = TypeVar("Content")


def read_record(path: Path, adapter: TypeAdapter[Content], kind: str, writer: str) -> Content:
    """Return what a file holds.

    Parameters
    ----------
    path
        The file.
    adapter
        Of its content.
    kind
        What it is called, "metrics".
    writer
        Which command writes it, for the one who misses it.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            msg = f"{path}: larger than {MAX_BYTES // 1_000_000} MB, not a file of this program"
            raise CalibrationError(msg)
        return adapter.validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such file; {writer}") from error
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        msg = f"{path}: not a {kind} file of this program: {key}: {fault['msg']}"
        raise CalibrationError(msg) from error

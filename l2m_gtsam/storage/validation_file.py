"""``validation.json``: how far a calibration still holds, and what that is told from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.metric_results import Record
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.validation_results import Validation

# Courses of a hundred sensors are some megabytes; more than this is not ours.
MAX_BYTES = 100_000_000


@dataclass(frozen=True)
class _ValidationFile(Record):
    format: Literal["l2m-validation"]
    version: Literal[1]
    validation: Validation


_ADAPTER = TypeAdapter(_ValidationFile)


def write_validation(path: Path, validation: Validation) -> None:
    """Write a validation; `read_validation` gives it back equal."""
    content = _ADAPTER.dump_json(_ValidationFile("l2m-validation", 1, validation))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content + b"\n")


def read_validation(path: Path) -> Validation:
    """Return the validation in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            msg = f"{path}: larger than {MAX_BYTES // 1_000_000} MB, not a file of this program"
            raise CalibrationError(msg)
        return _ADAPTER.validate_json(path.read_bytes()).validation
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such file; `l2m validate --out` writes it") from error
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        msg = f"{path}: not a validation file of this program: {key}: {fault['msg']}"
        raise CalibrationError(msg) from error

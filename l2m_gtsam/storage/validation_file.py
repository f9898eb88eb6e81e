"""``validation.json``: how far a calibration still holds, and what that is told from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from l2m_gtsam.records.metrics import Record
from l2m_gtsam.records.validation import Validation
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.record_file import read_record


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
    writer = "`l2m validate --out` writes it"
    return read_record(path, _ADAPTER, "validation", writer).validation

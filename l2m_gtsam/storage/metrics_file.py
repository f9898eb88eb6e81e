"""``metrics.json``: the figures that a report is drawn from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.metric_results import Metrics, Record
from l2m_gtsam.storage.atomic import atomic_path

# Figures of a hundred sensors are some megabytes; more than this is not ours.
MAX_BYTES = 100_000_000


@dataclass(frozen=True)
class _MetricsFile(Record):
    format: Literal["l2m-metrics"]
    version: Literal[1]
    metrics: Metrics


_ADAPTER = TypeAdapter(_MetricsFile)


def write_metrics(path: Path, metrics: Metrics) -> None:
    """Write metrics; `read_metrics` gives them back equal."""
    # What only several drives have is left out of files of one.
    content = _ADAPTER.dump_json(_MetricsFile("l2m-metrics", 1, metrics), exclude_none=True)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content + b"\n")


def read_metrics(path: Path) -> Metrics:
    """Return the metrics in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            msg = f"{path}: larger than {MAX_BYTES // 1_000_000} MB, not a file of this program"
            raise CalibrationError(msg)
        return _ADAPTER.validate_json(path.read_bytes()).metrics
    except FileNotFoundError as error:
        msg = f"{path}: no such file; `l2m calibrate` writes it beside calibration.yaml"
        raise CalibrationError(msg) from error
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        msg = f"{path}: not a metrics file of this program: {key}: {fault['msg']}"
        raise CalibrationError(msg) from error

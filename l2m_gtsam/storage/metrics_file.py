"""``metrics.json``: the figures that a report is drawn from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from l2m_gtsam.records.metrics import Metrics, Record
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.record_file import read_record


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
    writer = "`l2m calibrate` writes it beside calibration.yaml"
    return read_record(path, _ADAPTER, "metrics", writer).metrics

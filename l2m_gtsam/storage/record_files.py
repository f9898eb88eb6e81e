"""Records as JSON: ``metrics.json``, ``validation.json``, ``slam.json`` and ``outcome.json``.

Each file is a head with format and version, then the record. Files are read without trust.
"""

import json
import math
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.options import first_fault
from l2m_gtsam.records.fleet import DATE, VERDICTS, DriveOutcome, SensorRow
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.record import Record, fields_of
from l2m_gtsam.records.validation import Validation
from l2m_gtsam.storage.bounded import read_content
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.report_id import checked_id, report_id
from l2m_gtsam.storage.result_set import check_set
from l2m_gtsam.storage.units import odd_poses

MAX_BYTES = 100_000_000  # figures of a hundred sensors are some megabytes
MAX_OUTCOME_BYTES = 10_000_000  # a hundred sensors are some 100 kB
UNIT = 1e-6  # by which a quaternion's length may differ from 1: it is written with nine digits
LEGEND = {
    "poses": "T_map_lidar at key poses: stamp_ns, p in metres, quaternion_xyzw",
    "covariance": "of a right perturbation, T_true = T_map_lidar Exp(error): rotation (rad), then "
    "translation (m), along the axes of the lidar",
    "odometry": "alone, from where the drive is said to begin; sigma along x, y, z of the map (m), "
    "and about them (deg)",
    "drift": "odometry alone less the localised poses, in m and deg",
    "chi2_per_dof": "mean square of whitened residuals; 1 is consistent",
    "scale": "longer: share by which all distances are longer than odometry has them, with its "
    "sigma; null where odometry's scale counts as right",
    "turn": "degrees per metre by which odometry turns too far to the left all along, with its "
    "sigma; absent where that was not estimated",
    "gain": "of a drive without a map: nats by which readings are likelier at the corrected poses "
    "than at odometry's, m rms between both, probability that odometry's are nearer to the truth; "
    "not shown: the poses are odometry's",
    "hints": "what options would make poses better",
    "steps": "mean square of the whitened differences between steps of the poses and odometry's",
    "truth": "errors against a trajectory that was given, nothing aligned; expected nees: 6",
    "start": "candidates for the start of the drive over the whole map, the likeliest first; "
    "margin: log likelihood ratio of the first and the second, NaN without a second",
}

Content = TypeVar("Content")


@dataclass(frozen=True)
class _MetricsFile(Record):
    format: Literal["l2m-metrics"]
    version: Literal[1]
    metrics: Metrics


@dataclass(frozen=True)
class _ValidationFile(Record):
    format: Literal["l2m-validation"]
    version: Literal[1]
    id: str = field(default="", kw_only=True)
    validation: Validation


@dataclass(frozen=True)
class _SlamHead(Record):
    format: Literal["l2m-slam"]
    version: Literal[4]
    id: str = field(default="", kw_only=True)
    legend: dict[str, str]


@dataclass(frozen=True)
class _SlamFile(LocalisationRecord, _SlamHead):
    """The head, and the fields of the record beside it."""


@dataclass(frozen=True)
class _OutcomeFile(Record):
    format: Literal["l2m-fleet-outcome"]
    version: Literal[1]
    outcome: DriveOutcome


_METRICS = TypeAdapter(_MetricsFile)
_VALIDATION = TypeAdapter(_ValidationFile)
_SLAM = TypeAdapter(_SlamFile)
_OUTCOME = TypeAdapter(_OutcomeFile)


def write_metrics(path: Path, metrics: Metrics) -> None:
    """Write ``metrics.json``, which a report is drawn from; `read_metrics` gives it back equal."""
    # What only several drives have is left out of files of one.
    _write(path, _METRICS.dump_json(_MetricsFile("l2m-metrics", 1, metrics), exclude_none=True))


def read_metrics(path: Path) -> Metrics:
    """Return the metrics in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    writer = "`l2m calibrate` writes it beside calibration.yaml"
    return _read(path, _METRICS, "metrics", writer).metrics


def write_validation(path: Path, validation: Validation) -> str:
    """Write ``validation.json`` and return its id."""
    file = _ValidationFile("l2m-validation", 1, validation)
    found = report_id(json.loads(_VALIDATION.dump_json(file, by_alias=True)))
    _write(path, _VALIDATION.dump_json(replace(file, id=found), by_alias=True))
    return found


def write_slam(path: Path, record: LocalisationRecord) -> str:
    """Write ``slam.json`` and return its id; `read_slam` gives it back equal.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    absent = {name for name in ("judgement", "gain", "hints", "turn") if not getattr(record, name)}
    file = _SlamFile("l2m-slam", 4, LEGEND, **fields_of(record, LocalisationRecord))
    found = report_id(json.loads(_SLAM.dump_json(file, exclude=absent)))
    _write(path, _SLAM.dump_json(replace(file, id=found), exclude=absent))
    return found


def record_id(path: Path) -> str:
    """Return the report id of a ``slam.json`` or ``validation.json`` that was read."""
    raw = read_content(path, MAX_BYTES, CalibrationError)
    return checked_id(path, json.loads(raw), CalibrationError)


def read_slam(path: Path) -> LocalisationRecord:
    """Return the localisation in a file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    file = _read(path, _SLAM, "localisation", "`l2m slam` writes it")
    found = LocalisationRecord(**fields_of(file, LocalisationRecord))
    if odd := _odd_poses(found):
        raise CalibrationError(f"{path}: not a localisation file of this program: {odd}")
    return found


def _odd_poses(record: LocalisationRecord) -> str:
    """Return what is wrong with the poses of a localisation; nothing if all can be."""
    if not record.poses:
        return "it has no poses"
    p = [each.p for part in (record.poses, record.odometry) for each in part]
    q = [each.quaternion_xyzw for part in (record.poses, record.odometry) for each in part]
    return odd_poses(np.array(p), np.array(q))


def write_outcome(path: Path, outcome: DriveOutcome) -> None:
    """Write ``outcome.json`` of a drive of a fleet; `read_outcome` gives it back equal."""
    _write(path, _OUTCOME.dump_json(_OutcomeFile("l2m-fleet-outcome", 1, outcome), indent=1))


def read_outcome(path: Path) -> DriveOutcome | None:
    """Return an outcome; None where there is none, or none that can be gone on from.

    One that was damaged or edited counts as none: its drive is computed again, which is safer than
    a table of what was never found.
    """
    try:
        raw = read_content(path, MAX_OUTCOME_BYTES, CalibrationError)
        found = _OUTCOME.validate_json(raw).outcome
    except (CalibrationError, ValidationError):
        return None
    return found if _sound(found) else None


def _sound(outcome: DriveOutcome) -> bool:
    """Return whether an outcome can be what `write_outcome` was given."""
    return (
        bool(outcome.sensors) != bool(outcome.error)
        and _is_date(outcome.start)
        and 0 <= outcome.duration < math.inf
        and all(map(_sound_row, outcome.sensors))
    )


def _sound_row(sensor: SensorRow) -> bool:
    """Return whether a row has known verdicts, and a rotation or none."""
    q = sensor.quaternion_xyzw
    none = all(map(math.isnan, q))
    judged = sensor.verdict in VERDICTS and sensor.own_verdict in ("", *VERDICTS)
    return judged and (none or abs(math.hypot(*q) - 1) < UNIT)


def _is_date(text: str) -> bool:
    """Return whether text is a date, or empty: that of a drive which was not read."""
    try:
        return not text or bool(datetime.strptime(text, DATE).replace(tzinfo=UTC))
    except ValueError:
        return False


def _write(path: Path, plain: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(plain + b"\n")


def _read(path: Path, adapter: TypeAdapter[Content], kind: str, writer: str) -> Content:
    """Return what a file holds.

    Parameters
    ----------
    adapter
        Of its content.
    kind
        What it is called in messages, "metrics".
    writer
        Which command writes it, for the message about a missing file.

    Raises
    ------
    CalibrationError
        The file is missing, damaged or something else.
    """
    raw = read_content(path, MAX_BYTES, CalibrationError, f"no such file; {writer}")
    try:
        found = adapter.validate_json(raw)
    except ValidationError as error:
        fault = first_fault(error)
        raise CalibrationError(f"{path}: not a {kind} file of this program: {fault}") from error
    check_set(path, CalibrationError)
    checked_id(path, json.loads(raw), CalibrationError)
    return found

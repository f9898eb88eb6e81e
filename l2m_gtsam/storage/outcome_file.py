"""``outcome.json`` beside the results of each drive of a fleet: what became of it."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.records.fleet import DATE, VERDICTS, DriveOutcome, SensorRow
from l2m_gtsam.records.metrics import Record
from l2m_gtsam.storage.atomic import atomic_path

MAX_BYTES = 10_000_000  # a hundred sensors are some 100 kB
UNIT = 1e-6  # by which a quaternion's length may differ from 1: it is written with nine digits


@dataclass(frozen=True)
class _OutcomeFile(Record):
    format: Literal["l2m-fleet-outcome"]
    version: Literal[1]
    outcome: DriveOutcome


_ADAPTER = TypeAdapter(_OutcomeFile)


def write_outcome(path: Path, outcome: DriveOutcome) -> None:
    """Write an outcome; `read_outcome` gives it back equal."""
    content = _ADAPTER.dump_json(_OutcomeFile("l2m-fleet-outcome", 1, outcome), indent=1)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content + b"\n")


def read_outcome(path: Path) -> DriveOutcome | None:
    """Return an outcome; None where there is none, or none that can be gone on from.

    One that was damaged or edited counts as none: its drive is computed again, which is safer than
    a table of what was never found.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            return None
        found = _ADAPTER.validate_json(path.read_bytes()).outcome
    except (OSError, ValidationError):
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
    """Return whether a row has a verdict that there is, and a rotation or none."""
    q = sensor.quaternion_xyzw
    none = all(map(math.isnan, q))
    return sensor.verdict in VERDICTS and (none or abs(math.hypot(*q) - 1) < UNIT)


def _is_date(text: str) -> bool:
    """Return whether text is a date, or empty: that of a drive which was not read."""
    try:
        return not text or bool(datetime.strptime(text, DATE).replace(tzinfo=UTC))
    except ValueError:
        return False

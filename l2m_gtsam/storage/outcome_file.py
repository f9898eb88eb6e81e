"""``outcome.json`` beside the results of each drive of a fleet: what became of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter, ValidationError

from l2m_gtsam.fleet_results import DriveOutcome
from l2m_gtsam.metric_results import Record
from l2m_gtsam.storage.atomic import atomic_path

MAX_BYTES = 10_000_000  # a hundred sensors are some 100 kB


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
    """Return an outcome; None where there is none, or none that can be gone on from."""
    try:
        if path.stat().st_size > MAX_BYTES:
            return None
        return _ADAPTER.validate_json(path.read_bytes()).outcome
    except (OSError, ValidationError):
        return None

"""What happened on a drive that is localised on line, beside its poses."""

from dataclasses import dataclass
from enum import StrEnum


class EventKind(StrEnum):
    """Of an event."""

    RESUMED = "resumed"
    UNUSABLE = "unusable"
    OUT_OF_ORDER = "out_of_order"
    ODOMETRY_GAP = "odometry_gap"
    ODOMETRY_JUMP = "odometry_jump"
    GAP_DECIDED = "gap_decided"
    JUMP_DECIDED = "jump_decided"
    SENSOR_SILENT = "sensor_silent"
    SENSOR_STUCK = "sensor_stuck"
    SENSOR_BACK = "sensor_back"
    SCAN_REFUSED = "scan_refused"
    READINGS_REFUSED = "readings_refused"
    READINGS_FIT = "readings_fit"
    FIELD_LEARNT = "field_learnt"
    START_FOUND = "start_found"
    START_OPEN = "start_open"
    CORRECTION_REFUSED = "correction_refused"
    ONE_SENSOR = "one_sensor"
    CALIBRATION_REFUTED = "calibration_refuted"


@dataclass(frozen=True)
class OnlineEvent:
    """Something that happened.

    Attributes
    ----------
    stamp_ns
        When, in the clock of the data.
    kind
        What.
    text
        A sentence.
    """

    stamp_ns: int
    kind: EventKind
    text: str

    def __str__(self) -> str:
        return f"{1e-9 * self.stamp_ns:.3f} {self.kind.value}: {self.text}"

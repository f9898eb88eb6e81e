"""What comes out of a fleet of drives: frozen records of plain numbers.

Positions are in metres in the lidar frame, fields in microtesla, angles in degrees, times in
seconds. A number that does not exist is NaN, a standard deviation of what is not determined is
infinite. Rows of axes are in the order x, y, z.
"""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from l2m_gtsam.records.record import Record, Row
from l2m_gtsam.text import significant

VERDICTS = ("pass", "warn", "fail")
"""On a sensor."""
ERROR = "error"
"""Verdict on a drive that was not calibrated, beside those."""
DATE = "%Y-%m-%dT%H:%M:%SZ"
"""ISO 8601 in UTC, as `strftime` has it."""

Axes = Annotated[Row, Field(min_length=3, max_length=3)]
Quaternion = Annotated[Row, Field(min_length=4, max_length=4)]


@dataclass(frozen=True)
class RowKey(Record):
    """What the outcome of a drive depends on.

    Attributes
    ----------
    bag, map
        SHA-256 of each; empty where it cannot be read.
    config
        SHA-256 of the parts of the configuration that a calibration and its verdict depend on.
    program
        Version of this program.
    """

    bag: str
    map: str
    config: str
    program: str


@dataclass(frozen=True)
class SensorRow(Record):
    """One sensor on one drive.

    Attributes
    ----------
    sensor
        Name.
    verdict, reason
        That of the sensor or, where it is worse, that of map and drive; the gravest reason.
    t, t_sigma
        ``t_lidar_mag`` in metres.
    quaternion_xyzw, rotation_sigma
        ``R_lidar_mag``; standard deviation about the sensor's axes in degrees.
    scale
        Gain of each sensor axis.
    H, H_sigma
        Hard iron.
    hard_iron, hard_iron_sigma
        Its length.
    residual_rms
        Of the residuals, microtesla.
    chi2
        Of the residuals per degree of freedom: 1 is consistent.
    rejected
        Share of the readings inside the map that were rejected.
    own_verdict
        That of the sensor alone; empty in files of before.
    """

    sensor: str
    verdict: str
    reason: str
    t: Axes
    t_sigma: Axes
    quaternion_xyzw: Quaternion
    rotation_sigma: Axes
    scale: Axes
    H: Axes
    H_sigma: Axes
    hard_iron: float
    hard_iron_sigma: float
    residual_rms: float
    chi2: float
    rejected: float
    own_verdict: str = ""


@dataclass(frozen=True)
class Computation(Record):
    """When an outcome was computed (UTC, ISO 8601), and how long that took."""

    date: str
    seconds: float


@dataclass(frozen=True)
class DriveOutcome(Record):
    """What became of one drive.

    Attributes
    ----------
    key
        What it depends on.
    start
        Of the drive, from its stamps, UTC, ISO 8601; empty where they were not read.
    duration
        Of the drive.
    sensors
        A row each; none where the drive was not calibrated.
    error
        Why it was not; empty where it was.
    lasting
        Whether it would end so again: not if a worker died or a disk was full.
    made
        When and how long.
    """

    key: RowKey
    start: str
    duration: float
    sensors: tuple[SensorRow, ...]
    error: str
    lasting: bool
    made: Computation


@dataclass(frozen=True)
class Outlier:
    """A parameter that is not what the vehicle's other drives found.

    Attributes
    ----------
    parameter
        Its name and unit: "t_x (mm)".
    deviation
        From the median of the usual drives, in that unit.
    score
        The same in units of the uncertainty or of the drives' spread, whichever is larger.
    """

    parameter: str
    deviation: float
    score: float

    def __str__(self) -> str:
        name, _, unit = self.parameter.partition(" (")
        sign = "" if self.deviation < 0 else "+"
        by = f"{sign}{significant(self.deviation)} {unit.rstrip(')')}"
        return f"{name} {by}, {self.score:.1f} times expected"


@dataclass(frozen=True)
class FleetRow:
    """A row of the fleet's table: a sensor on a drive, or a drive that was not calibrated.

    Attributes
    ----------
    vehicle, bag
        Names.
    folder
        Of the drive's results, relative to the fleet's, with slashes.
    date
        When the drive was, UTC, ISO 8601; empty where it is not known.
    duration
        Of the drive.
    sensor
        Absent for a drive that was not calibrated.
    error
        Why it was not.
    outliers
        Parameters that are not what other drives found, the worst first.
    """

    vehicle: str
    bag: str
    folder: str
    date: str
    duration: float
    sensor: SensorRow | None
    error: str
    outliers: tuple[Outlier, ...] = ()

    @property
    def verdict(self) -> str:
        """Pass, warn, fail or error."""
        return ERROR if self.sensor is None else self.sensor.verdict

    @property
    def reason(self) -> str:
        """What speaks against it most, as a sentence; empty if nothing does."""
        return self.error if self.sensor is None else self.sensor.reason

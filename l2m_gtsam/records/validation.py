"""What a validation finds: frozen records of plain numbers, which `validation.json` holds.

Positions are in metres, fields in microtesla, angles in degrees, times in seconds. A number that
does not exist is NaN. Rows of axes are in the order x, y, z.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from pydantic import AliasChoices, Field

from l2m_gtsam.data import SaturatedAxis
from l2m_gtsam.records.error_budget import OffsetDrift, OffsetJump
from l2m_gtsam.records.metrics import DriveMetrics, MapPicture, Series
from l2m_gtsam.records.places import ChangedSource, WhatChanged
from l2m_gtsam.records.provenance import NamedSource
from l2m_gtsam.records.record import Record, Row
from l2m_gtsam.records.verdict import Threshold, Verdict


class CalibrationPart(StrEnum):
    """A part of a calibration that may change by itself."""

    PLACE = "place"
    ROTATION = "rotation"
    GAINS = "gains"
    ANGLES = "angles"
    OFFSET = "offset"
    CLOCK = "clock"


@dataclass(frozen=True)
class FieldError(Record):
    """Readings less the map's field, along the axes of the lidar.

    Attributes
    ----------
    squared
        Mean of the squared length in uT^2: the paper's e_B.
    mean, std
        Of the length.
    mean_axes, std_axes
        Of the difference along each axis.
    """

    squared: float
    mean: float
    std: float
    mean_axes: Row
    std_axes: Row


@dataclass(frozen=True)
class ChiSquare(Record):
    """A sum of squares in units of its variances, beside what chance makes of it.

    Attributes
    ----------
    value
        The sum.
    freedom
        Its degrees of freedom.
    low, high
        Between these it lies in 95 % of all cases if everything is as stated. Of readings it is
        counted that the sensor's noise was itself estimated from so many others.
    """

    value: float
    freedom: int
    low: float
    high: float

    @property
    def ratio(self) -> float:
        """Per degree of freedom; 1 is consistent."""
        return self.value / self.freedom if self.freedom else float("nan")

    @property
    def consistent(self) -> bool:
        """Whether it lies where chance puts it in 95 % of all cases."""
        return self.low <= self.value <= self.high


@dataclass(frozen=True)
class CalibrationChange(Record):
    """A part of a calibration that is no longer what it was.

    Attributes
    ----------
    part
        Which.
    change, sigma
        Now less then, and its standard deviation: place along the lidar's axes in m; degrees by
        which the sensor turned about its own axes, R_lidar_mag = R_lidar_mag_then exp(change);
        gains of its axes; angles by which those between its axes x y, y z, z x fell short of 90
        degrees, in degrees; H in uT; time offset in s.
    size
        Length of the vector; of gains and angles the largest change.
    chance
        How often chance alone makes as much of it.
    """

    part: CalibrationPart
    change: Row
    sigma: Row
    size: float
    chance: float


@dataclass(frozen=True)
class MinimumDetectableChange(Record):
    """The smallest change of a part that shows: on a drive, all others as calibrated.

    Its test misses it once in a hundred times, in its worst direction. In the units of
    ``CalibrationChange``; infinite where it shows none.
    """

    part: CalibrationPart
    size: float


@dataclass(frozen=True)
class ValidatedSensor(Record):
    """One sensor of a drive beside what map and calibration predict.

    Attributes
    ----------
    sensor
        Name.
    ending
        How the solve of the calibration ended; empty where it simply succeeded.
    readings, rejected, outside
        That count; that no calibration explains beside the others; without map.
    before, after
        Readings as they are and corrected, less the map's field.
    expected
        What sensor, map and poses lead to expect of a residual per axis, rms.
    refitted, uniform
        What any C and H leave of the readings at the calibrated place, with the map and with a
        field that is the same everywhere, per axis, rms.
    nis
        Normalised innovation squared of all readings together.
    parameters
        The same of the calibration's own parameters: the estimate of this drive beside that of the
        calibration.
    changes
        Parts that are no longer right, the plainest first.
    detectable
        What the drive would have shown.
    series
        The course of the drive, thinned.
    limits
        Of its range, that readings exceed; these do not count.
    reads_as
        The sensor whose calibration its readings fit, and all figures here are of, where the two
        are exchanged; empty where it is its own.
    """

    sensor: str
    ending: str
    readings: int
    rejected: int
    outside: int
    before: FieldError
    after: FieldError
    expected: float
    refitted: float
    uniform: float
    nis: ChiSquare
    parameters: ChiSquare
    changes: tuple[CalibrationChange, ...]
    detectable: Annotated[
        tuple[MinimumDetectableChange, ...],
        Field(
            validation_alias=AliasChoices("noticeable", "detectable"),
            serialization_alias="noticeable",  # as `validation.json` has always called them
        ),
    ]
    series: Series
    limits: tuple[SaturatedAxis, ...] = ()
    reads_as: str = ""

    @property
    def unexplained(self) -> float:
        """What the map leaves beside what a uniform field would: 0 is all explained, 1 nothing."""
        return self.refitted / self.uniform if self.uniform > 0 else float("nan")


@dataclass(frozen=True)
class NotValidated(Record):
    """A sensor that was not tested.

    Attributes
    ----------
    sensor
        Name.
    reason
        Why, as a sentence.
    faulty
        Whether something is wrong with it, or it is only not among what was given.
    """

    sensor: str
    reason: str
    faulty: bool


class Displaced(StrEnum):
    """What is not where it was, for all sensors alike."""

    LIDAR = "lidar"
    FRAME = "frame"


@dataclass(frozen=True)
class Displacement(Record):
    """A displacement that sensors share: one explains them all as well as many do.

    Attributes
    ----------
    of
        What was displaced; both where readings do not show which.
    shift, shift_sigma
        By which the sensors, at their middle, moved along the lidar's axes; if only the frame was
        displaced, by which poses are to be moved, at their middle, along the map's. Metres; zero
        where there is none.
    turn, turn_sigma
        The same of a turn about these axes, as a rotation vector in degrees.
    gain
        Over changes of single sensors: twice the logarithm of the likelihood ratio, less what
        the parameters cost (the BIC).
    """

    of: tuple[Displaced, ...]
    shift: Row
    shift_sigma: Row
    turn: Row
    turn_sigma: Row
    gain: float


@dataclass(frozen=True)
class DetectableShift(Record):
    """The smallest shift of all sensors together that a drive shows, with nothing else changed.

    Its test misses it once in a hundred times, in its worst direction. In metres; infinite where it
    shows none.
    """

    of: Displaced
    size: float


@dataclass(frozen=True)
class DriveValidation(Record):
    """A calibration beside a drive.

    Attributes
    ----------
    sensors, missing
        Those that could be compared, and the others.
    drive, picture
        How the vehicle moved, and the map around it.
    doubts, notes
        What speaks against the outcome, and what is worth knowing of it, a sentence each.
    sources
        What changed at the place since it was mapped.
    explanations
        What the readings say of place and vehicle, the best first; empty where no steel is seen.
    displacement
        What all sensors share. Their own changes are those beside it.
    detectable_shifts
        Of what all sensors share, that the drive would have shown.
    jumps
        Of H during the drive, in order of time. Other changes of H are those before the first.
    drifts
        Of H over the drive. Other changes of H are those at its beginning.
    """

    sensors: tuple[ValidatedSensor, ...]
    missing: tuple[NotValidated, ...]
    drive: DriveMetrics
    picture: MapPicture
    doubts: tuple[str, ...]
    notes: tuple[str, ...]
    sources: tuple[ChangedSource, ...] = ()
    explanations: tuple[WhatChanged, ...] = ()
    displacement: Displacement | None = None
    detectable_shifts: tuple[DetectableShift, ...] = ()
    jumps: tuple[OffsetJump, ...] = ()
    drifts: tuple[OffsetDrift, ...] = ()


@dataclass(frozen=True)
class ChangeTest(Record):
    """Whether a group of parameters differs between two calibrations by more than chance.

    Attributes
    ----------
    name
        Of the group.
    chi_square, freedom
        Distance of both in units of their covariances; 0 degrees if nothing can be compared.
    chance
        How often chance alone makes as much of it.
    """

    name: str
    chi_square: float
    freedom: int
    chance: float


@dataclass(frozen=True)
class ComparedSensor(Record):
    """One sensor in two calibrations.

    Attributes
    ----------
    sensor
        Name.
    difference, sigma
        New less old: t in m, C row by row, H in uT, and its standard deviation, shape (15,);
        NaN and infinite for what one of them leaves open.
    tests
        Over t, rotation, gains, angles, C, H and all.
    changes
        Parts that have changed beyond both uncertainties, the plainest first.
    detectable
        What would have shown beside both uncertainties, each change by itself; empty in files of
        before.
    """

    sensor: str
    difference: Row
    sigma: Row
    tests: tuple[ChangeTest, ...]
    changes: tuple[CalibrationChange, ...]
    detectable: tuple[MinimumDetectableChange, ...] = ()

    def test(self, name: str) -> ChangeTest:
        """Return the test of a group by its name."""
        return next(each for each in self.tests if each.name == name)


@dataclass(frozen=True)
class CalibrationComparison(Record):
    """A calibration beside an older one.

    Attributes
    ----------
    sensors, missing
        Those in both, and the others.
    assumption
        How errors of both are taken to go together, as a sentence.
    same_bag
        Whether a drive took part in both.
    failed
        Which of both were judged FAIL: "new", "old".
    """

    sensors: tuple[ComparedSensor, ...]
    missing: tuple[NotValidated, ...]
    assumption: str
    same_bag: bool
    failed: tuple[str, ...] = ()


@dataclass(frozen=True)
class Validation(Record):
    """All that `l2m validate` finds.

    Attributes
    ----------
    verdict
        With its reasons.
    drive
        Absent without a bag.
    comparison
        Absent without an older calibration.
    thresholds
        Of the verdict.
    sources
        Files that took part.
    versions
        Of the packages that computed it.
    """

    verdict: Verdict
    drive: DriveValidation | None
    comparison: CalibrationComparison | None
    thresholds: tuple[Threshold, ...]
    sources: tuple[NamedSource, ...]
    versions: dict[str, str]

"""Errors beside the noise of readings: what was stated, what a drive says, what they contribute."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.record import Record, Row


class ErrorCause(StrEnum):
    """Whose errors make an estimate uncertain."""

    NOISE = "noise"
    """Of the readings, independent from one to the next."""
    MAP = "map"
    """Errors of the field map."""
    SUITE = "suite"
    """Errors of the sensors that surveyed it."""
    POSES = "poses"
    """Errors of the drive's poses."""
    WANDER = "wander"
    """H that is not constant, and noise that lasts."""
    FIELD = "field"
    """A field that is not the map's for a time."""
    WARP = "warp"
    """A frame that is bent against the map's."""
    CLOCK = "clock"
    """A clock that drifts against that of the poses."""
    SMOOTHING = "smoothing"
    """Readings that are means over some time."""
    MOVING_PARTS = "moving parts"
    """H that follows how the vehicle moves."""
    CURRENTS = "currents"
    """What recorded numbers add to the readings."""
    PRIORS = "priors"
    """What was known of the sensor beforehand."""
    UNMODELLED = "unmodelled"
    """None of these: parts of the drive scatter more than all of them explain."""


@dataclass(frozen=True)
class VarianceShare:
    """What a cause has of the variances of a sensor's parameters.

    Attributes
    ----------
    cause
        Whose errors.
    t, C, H
        Share of the sum of the variances of the coordinates, entries and axes of each, 0 to 1; over
        all causes they add to one. Zero in all of them for what the drive does not determine.
    """

    cause: ErrorCause
    t: float
    C: float
    H: float


class DisturbanceKind(StrEnum):
    """What kind of process."""

    WANDER = "wander"
    """H of a sensor is not constant, or its noise lasts."""
    POSES = "poses"
    """Poses are wrong by errors that last."""
    FIELD = "field"
    """The field is not the map's for a time, for all sensors alike."""
    WARP = "warp"
    """The drive's frame is bent against the map's."""
    CLOCK = "clock"
    """The time offset of a sensor is not constant."""
    SMOOTHING = "smoothing"
    """A sensor's readings are smoothed over some time, against the poses."""
    MOVING_PARTS = "moving parts"
    """H of a sensor follows how the vehicle moves: iron that steers, currents of motors."""


@dataclass(frozen=True)
class Disturbance:
    """A process that was found on a drive, and that sigmas include.

    Attributes
    ----------
    kind
        What it is.
    sizes
        Standard deviations by name and unit, along each axis: ``noise_ut`` (that lasts, 1/f) and
        ``walk_ut`` (from the start to the end of a drive) of H or of a field; of poses in the
        lidar's frame ``tilt_deg`` and ``floor_m`` (along x and y), ``heading_deg`` and
        ``height_m`` (along z); how long an error lasts, ``lasting_s``; ``shift_m``, of the
        floor's axes; ``drift_s``, of a clock from the start to the end of a drive;
        ``smoothing_s``, of the time that a reading is a mean over; ``turning_ut``,
        ``steering_ut``, ``speed_ut`` and ``acceleration_ut``, of an H that follows these, for a
        standard deviation of each.
    gain
        Twice the logarithm by which the drive is more likely with it.
    sensor
        Whose readings it is in; all if none is named.
    """

    kind: DisturbanceKind
    sizes: dict[str, float]
    gain: float
    sensor: str | None = None


MOST_JUMPS = 3  # of H of one sensor on one drive: one that jumps so often wanders


@dataclass(frozen=True)
class OffsetChange(Record):
    """A change of H on a drive.

    Attributes
    ----------
    sensor
        Of which.
    stamp_ns, seconds
        Of a jump when it is: by its stamps, and after the first reading of the drive that counts.
        Of a drift when the drive begins, and how long it is.
    change, sigma
        H after less before, or at the end less at the beginning, and its standard deviation, uT.
    """

    sensor: str
    stamp_ns: int
    seconds: float
    change: Row
    sigma: Row


@dataclass(frozen=True)
class OffsetJump(OffsetChange):
    """A jump of H at one moment of a drive.

    Attributes
    ----------
    bag
        The drive, where several were calibrated together; then times are its own.
    """

    bag: str = ""


@dataclass(frozen=True)
class OffsetDrift(OffsetChange):
    """H that drifts over a drive, steadily or ever more slowly.

    Attributes
    ----------
    time_constant_s
        Of the exponential by which it slows down; absent where it is steady.
    """

    time_constant_s: float | None = None

    def share(self, stamp_ns: IntArray) -> FloatArray:
        """Return how much of it is done at some stamps, 0 to 1 during the drive, shape (N,)."""
        elapsed_s: FloatArray = 1e-9 * (stamp_ns - self.stamp_ns).astype(np.float64)
        return drift_share(elapsed_s, self.seconds, self.time_constant_s)

    @property
    def half_s(self) -> float:
        """After how many seconds half of it is done."""
        if self.time_constant_s is None:
            return self.seconds / 2
        whole = -np.expm1(-self.seconds / self.time_constant_s)
        return float(-self.time_constant_s * np.log1p(-whole / 2))


def drift_share(elapsed_s: FloatArray, whole_s: float, time_constant_s: float | None) -> FloatArray:
    """Return how much of a drift is done after some time of the whole."""
    if time_constant_s is None:
        return elapsed_s / whole_s
    return np.asarray(np.expm1(-elapsed_s / time_constant_s) / np.expm1(-whole_s / time_constant_s))


@dataclass(frozen=True)
class Unmodelled:
    """How many times larger the scatter of a drive's parts is than noise, map and poses explain.

    The covariances that are reported hold it, in the share of them that comes from the readings.
    One where the scatter is what is expected, or differs from it by no more than chance.

    Attributes
    ----------
    t, C, H, offset
        Mean over the parameters of each, in their own sigmas.
    """

    t: float = 1.0
    C: float = 1.0
    H: float = 1.0
    offset: float = 1.0

    @property
    def largest(self) -> float:
        """The largest of them."""
        return max(self.t, self.C, self.H, self.offset)

    @property
    def scale(self) -> FloatArray:
        """Factor of each sigma, t, C row by row, H, time offset, shape (16,)."""
        return np.asarray(np.sqrt(np.repeat([self.t, self.C, self.H, self.offset], (3, 9, 3, 1))))


EXPLAINED = Unmodelled()


FACTOR = 1.5  # a sigma that is stated to this is as good as one can ask
LEAST_GAIN = 11.0  # twice a logarithm; 0.1 % of right ones have more by chance (chi-square of one)


@dataclass(frozen=True)
class StatedSize:
    """Errors whose standard deviation was stated, and what the readings show of it.

    Attributes
    ----------
    cause
        Whose errors.
    ratio
        Standard deviation that the readings show over the one stated.
    gain
        Twice the logarithm by which the readings are more likely with it than as stated.
    sensor
        Which sensor's, or the one that alone shows errors of poses; all if none is named.
    """

    cause: ErrorCause
    ratio: float
    gain: float
    sensor: str | None = None

    @property
    def is_wrong(self) -> bool:
        """Whether what was stated is not what the readings show."""
        return self.gain > LEAST_GAIN and not 1 / FACTOR < self.ratio < FACTOR


class DurationSource(StrEnum):
    """Where it is known from."""

    GIVEN = "given"
    """It was stated."""
    FOUND = "found"
    """The readings show it."""
    ASSUMED = "assumed"
    """Nothing was stated, and readings do not contradict what is assumed."""


@dataclass(frozen=True)
class PoseDuration:
    """How long errors of poses last, whose sizes were stated.

    Attributes
    ----------
    seconds
        Time over which the correlation of two errors falls to 1/e.
    source
        Where that is known from.
    """

    seconds: float
    source: DurationSource

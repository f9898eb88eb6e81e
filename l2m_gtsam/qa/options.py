"""Thresholds of verdicts, and of outliers in a fleet."""

from collections.abc import Iterable
from typing import Any, Self

from pydantic import Field, PositiveFloat, model_validator

from l2m_gtsam.options import Options, UnitQuaternion, meanings
from l2m_gtsam.records.verdict import Level, Reason, Threshold


class Limit(Options):
    """From where on a figure is worth a warning, and from where on a failure."""

    warn: PositiveFloat
    """Above this the verdict is WARN at least."""
    fail: PositiveFloat
    """Above this the verdict is FAIL."""

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.fail < self.warn:
            msg = f"fail must not be less than warn, it is {self.fail:g} against {self.warn:g}"
            raise ValueError(msg)
        return self

    def level(self, value: float) -> Level:
        """Return the level that a figure leads to; NaN passes."""
        if value > self.fail:
            return Level.FAIL
        return Level.WARN if value > self.warn else Level.PASS

    def reasons(self, value: float, text: str) -> list[Reason]:
        """Return a reason with this text if a figure is above the limit; else none."""
        level = self.level(value)
        return [] if level is Level.PASS else [Reason(level, text)]


def thresholds(
    options: Options, names: Iterable[str] | None = None, prefix: str = ""
) -> tuple[Threshold, ...]:
    """Return the limits among some options, all if none are named."""
    model = type(options)
    return tuple(
        Threshold(prefix + name, limit.warn, limit.fail, meanings(model).get(name, ""))
        for name in names or model.model_fields
        if isinstance(limit := getattr(options, name), Limit)
    )


class Nominal(Options):
    """How a sensor was meant to be mounted, to judge by; the solve does not use it."""

    t_lidar_mag: tuple[float, float, float] | None = None
    """Its place in the lidar frame, metres."""
    quaternion_xyzw: UnitQuaternion | None = None
    """R_lidar_mag, from the sensor's axes to the lidar's."""


class ValidationOptions(Options):
    """Thresholds of the verdict of `l2m validate`.

    It shares `qa.unexplained`, `qa.rejected`, `qa.outside_map` and `qa.saturated` with the report.
    """

    chance: float = Field(default=1e-3, gt=0, lt=0.1)
    """Share of unchanged sensors in which a change may be found by chance."""
    place_m: Limit = Limit(warn=0.01, fail=0.03)
    """Change of a sensor's place, metres. A change counts if chance does not explain it."""
    rotation_deg: Limit = Limit(warn=0.3, fail=1.0)
    """Change of its rotation, degrees."""
    gain: Limit = Limit(warn=0.01, fail=0.03)
    """Largest change of the gain of one of its axes."""
    angle_deg: Limit = Limit(warn=0.3, fail=1.0)
    """Largest change of an angle between two of its axes, degrees."""
    offset_ut: Limit = Limit(warn=0.5, fail=2.0)
    """Change of its offset H, microtesla."""
    clock_s: Limit = Limit(warn=0.005, fail=0.1)
    """Change of its time offset, seconds."""
    nis: Limit = Limit(warn=1.5, fail=4.0)
    """Normalised innovation squared per degree of freedom, where no part of the calibration has
    changed; 1 is consistent."""


class SlamQaOptions(Options):
    """Thresholds of the verdict of `l2m slam`.

    It shares `qa.rejected`, `qa.outside_map` and `qa.chi_square` with the report on a calibration.
    """

    position_sigma_m: Limit = Limit(warn=0.1, fail=0.5)
    """Largest standard deviation of the position of a key pose along an axis of the map, metres."""
    heading_sigma_deg: Limit = Limit(warn=2.0, fail=10.0)
    """Largest standard deviation of the heading of a key pose, degrees."""
    steps: Limit = Limit(warn=2.0, fail=4.0)
    """Mean square of what steps between localised poses differ by from odometry's, in units of its
    covariance; 1 is consistent."""
    scans: Limit = Limit(warn=0.2, fail=0.8)
    """Share of the registrations of scans that contradict odometry and the others. Against the rest
    of the graph they are judged by `steps`."""
    nees: Limit = Limit(warn=3.0, fail=10.0)
    """Normalised squared error of the poses against the truth, if one is given, per degree of
    freedom; 1 is consistent. Pose errors of a drive are correlated: a drive counts as one case."""
    chance: float = Field(default=1e-3, gt=0, lt=0.1)
    """Share of true calibrations that may, by chance, be reported as changed by refining them."""


FORMER_HALVES = "halves_sigmas"


class QaOptions(Options):
    """Thresholds of the verdict in a report."""

    @model_validator(mode="before")
    @classmethod
    def _with_former_halves(cls, given: Any) -> Any:
        """Take `halves_sigmas`, as it was, for `halves_apart`.

        It limited the root mean square over t, C and H in sigmas, by 2 and 4 where this has 1 and 2
        of what chance exceeds seldom.
        """
        if not (isinstance(given, dict) and isinstance(given.get(FORMER_HALVES), dict)):
            return given
        former = {key: value for key, value in given.items() if key != FORMER_HALVES}
        limits = given[FORMER_HALVES]
        halved = {
            name: value / 2 if isinstance(value, int | float) else value
            for name, value in limits.items()
        }
        return {"halves_apart": halved, **former}

    position_sigma_m: Limit = Limit(warn=0.01, fail=0.03)
    """Largest standard deviation of a sensor's position, metres."""
    rotation_sigma_deg: Limit = Limit(warn=0.5, fail=2.0)
    """Largest standard deviation of its rotation, degrees."""
    hard_iron_sigma_ut: Limit = Limit(warn=0.5, fail=2.0)
    """Largest standard deviation of H, microtesla."""
    unexplained: Limit = Limit(warn=0.5, fail=0.75)
    """What the calibration leaves of the readings beside what a uniform field would leave (0 is
    all explained, 1 nothing): above it the map does not fit the drive."""
    warp_m: float = Field(default=0.5, gt=0)
    """A drive's frame that is bent against the map's by more is of another place, metres: FAIL."""
    rejected: Limit = Limit(warn=0.02, fail=1 / 3)
    """Share of the readings inside the map that no distortion explains."""
    outside_map: Limit = Limit(warn=0.3, fail=0.9)
    """Share of the readings for which the map has no data."""
    saturated: Limit = Limit(warn=0.001, fail=0.1)
    """Share of the readings along an axis that are beyond the range of the sensor."""
    halves_chance: float = Field(default=1e-3, gt=0, lt=0.1)
    """Share of sound sensors whose halves of the drive may differ in t, C or H by chance."""
    halves_apart: Limit = Limit(warn=1.0, fail=2.0)
    """Distance of both halves of the drive in t, in C or in H, of all readings, over the one that
    chance exceeds in `halves_chance` of all sensors."""
    halves_m: float = Field(default=0.003, ge=0)
    """Halves that differ by less than this in position are alike in t whatever the sigmas,
    metres."""
    halves_deg: float = Field(default=0.2, ge=0)
    """The same for rotation and for each entry of C, as an angle, in degrees."""
    halves_ut: float = Field(default=0.3, ge=0)
    """The same for H, microtesla."""
    chi_square: Limit = Limit(warn=1.5, fail=4.0)
    """Mean square of the normalised residuals per degree of freedom; 1 is consistent."""
    autocorrelation: float = Field(default=0.5, gt=0, le=1)
    """Correlation of the residuals of neighbouring readings above which sigmas that count each
    reading as independent are worth a warning."""
    time_offset_s: Limit = Limit(warn=0.005, fail=1.0)
    """Size of a time offset that was found and taken into account, seconds."""
    hard_iron_ut: float = Field(default=50.0, gt=0)
    """Length of H from which it is named in the verdict: more than the Earth's field."""
    scale: Limit = Limit(warn=0.3, fail=0.8)
    """How far the gain of a sensor's axis may be from 1."""
    skew_deg: Limit = Limit(warn=10.0, fail=30.0)
    """How far the angle between two sensor axes may be from a right angle, degrees."""
    nominal: dict[str, Nominal] = Field(default_factory=dict)
    """How sensors were meant to be mounted, by name; where nothing is given, the places of
    `calibration.priors.position` and the rotations of `calibration.priors.rotation`. Those of
    `calibration.start` are rough: they only show that two sensors are swapped."""
    nominal_m: Limit = Limit(warn=0.05, fail=0.3)
    """Distance between found and nominal place, metres."""
    nominal_deg: Limit = Limit(warn=10.0, fail=45.0)
    """Angle between found and nominal rotation, degrees."""
    axes_deg: float = Field(default=15.0, gt=0, lt=45)
    """Sensor axes that lie this close to axes of the lidar are taken to be meant so, degrees."""
    short_drive_m: float = Field(default=5.0, ge=0)
    """A drive that leaves something open, or known too little, and is shorter is called short,
    metres."""
    few_headings: float = Field(default=0.3, ge=0, le=1)
    """A drive that leaves something open, or known too little, and took a smaller share of all
    headings is called straight."""
    map_days: PositiveFloat | None = None
    """Age of the map at the drive, in days since its survey or the last drive that it was given,
    above which the verdict is WARN at least; never if not given. The age is in the report."""
    halves: bool = True
    """Whether both halves of a drive, or several drives, are calibrated by themselves, and
    judged."""
    half_readings: int = Field(default=50, ge=30)
    """Readings of each sensor that a half is calibrated on, spread evenly over it, where more of
    them were rejected than `rejected` allows, and that drives are compared with."""
    validation: ValidationOptions = ValidationOptions()
    """Thresholds of `l2m validate`."""
    slam: SlamQaOptions = SlamQaOptions()
    """Thresholds of `l2m slam`."""


class FleetOptions(Options):
    """Thresholds and size of the fleet's page."""

    outlier: PositiveFloat = 5.0
    """How many times further than expected a parameter must be from the median of the vehicle's
    usual drives, at least half of all that agree with each other, to be marked: both in standard
    deviations of the difference and in standard deviations of these drives' spread."""
    drives: int = Field(default=4, ge=3)
    """Drives of a vehicle that know the parameter, below which nothing is marked: of two that
    differ none is the outlier, and of three the spread is hardly known."""
    least_m: float = Field(default=0.003, ge=0)
    """Positions that are closer than this to that median are never marked, metres."""
    least_deg: float = Field(default=0.2, ge=0)
    """The same for rotations, degrees."""
    least_ut: float = Field(default=0.3, ge=0)
    """The same for H, microtesla."""
    pictures: int = Field(default=60, ge=0)
    """Most trends that the page draws, those with outliers first: it stays small and quick."""

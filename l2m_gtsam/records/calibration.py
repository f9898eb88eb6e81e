"""The result of a calibration: frozen records, which ``calibration.yaml`` holds.

Frames and units are those of ``data``.
"""

from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, InFile, Matrix, SourceFile, SyncCounts, Vector
from l2m_gtsam.records.by_sensor import BySensor
from l2m_gtsam.records.error_budget import (
    EXPLAINED,
    Disturbance,
    OffsetJump,
    PoseDuration,
    StatedSize,
    Unmodelled,
    VarianceShare,
)
from l2m_gtsam.records.places import Cause, CauseGain, ChangedSource, clear_cause
from l2m_gtsam.records.provenance import DriveTrace, MapOrigin, RecordedDrive
from l2m_gtsam.records.record import KeyedBy
from l2m_gtsam.records.sensor_models import ModelComparison, MovingField
from l2m_gtsam.records.verdict import Judgement

Row15 = Annotated[list[float], Field(min_length=15, max_length=15)]
Rows16 = Annotated[list[list[float]], Field(min_length=16, max_length=16)]


class SensorStatus(StrEnum):
    """How the solve of one sensor ended."""

    SOLVED = "solved"
    UNDETERMINED = "undetermined"
    NOT_CONVERGED = "not_converged"
    NO_READINGS = "no_readings"
    OUTSIDE_MAP = "outside_map"
    DEAD_AXIS = "dead_axis"
    AMBIGUOUS = "ambiguous"
    CONTRADICTED = "contradicted"
    FLIPPED_AXIS = "flipped_axis"


class Uncertainty(StrEnum):
    """How a calibration counts the map's errors."""

    FULL = "full"
    INDEPENDENT = "independent"


@dataclass(frozen=True)
class ResidualFigures:
    """Residuals of one sensor over the readings used, in microtesla.

    Attributes
    ----------
    readings
        How many.
    rms_axes, rms, median_norm, p95_norm, max_norm
        Of ``C b + H - z``, with the field that the map has at the poses as they were given: root
        mean square along the sensor's axes and of the length, and more of the length.
    chi2_per_dof
        Compares what is left of them, once the errors of map and poses that the solve found are
        taken out, with the noise that it assumed: 1 is consistent.
    """

    readings: int
    rms_axes: Vector
    rms: float
    median_norm: float
    p95_norm: float
    max_norm: float
    chi2_per_dof: float


@dataclass(frozen=True)
class FoundStart:
    """Where the search for a start ended for one sensor.

    Attributes
    ----------
    t_lidar_mag
        Where the solve started in the lidar frame in metres, shape (3,).
    margin
        How many times more (root mean square) the second best place leaves of the readings;
        infinite if there is no other. Seen coarsely, which makes it smaller than it is, where
        that place was too bad to be followed.
    runner_up
        That place in the lidar frame in metres, shape (3,), if there is one.
    """

    t_lidar_mag: Vector
    margin: float
    runner_up: Vector | None

    def moved(self, by: FloatArray) -> "FoundStart":
        """Return the same for a place that is elsewhere by a vector in metres, shape (3,)."""
        other = None if self.runner_up is None else self.runner_up + by
        return replace(self, t_lidar_mag=self.t_lidar_mag + by, runner_up=other)

    def ambiguous(self, clear: float) -> bool:
        """Return whether the second best place leaves less than so many times as much."""
        return self.runner_up is not None and self.margin < clear


@dataclass(frozen=True)
class TimeOffset:
    """How far a sensor's clock is off the lidar's: a reading's pose is that at stamp + offset.

    Attributes
    ----------
    seconds
        The offset; zero where it is held.
    sigma
        Its standard deviation in seconds, infinite where it is held.
    cross_covariance
        Of (t, C row by row, H) with it, in m s, s and uT s, shape (15,); zero where it is held.
    held
        Why it is held at zero; empty where it is estimated.
    """

    seconds: float
    sigma: float
    cross_covariance: Annotated[FloatArray, InFile(Row15)]
    held: str

    @property
    def estimated(self) -> bool:
        """Whether the drive determined it."""
        return not self.held


class Return(StrEnum):
    """What was read when a place was passed again at another time."""

    NEVER = "not passed again"
    AS_MAPPED = "as mapped"
    DIFFERS = "differs again"


@dataclass(frozen=True)
class Disagreement:
    """A stretch of a drive over which readings fit neither the map nor any distortion.

    Attributes
    ----------
    sensors
        Names of those that disagree.
    start_ns, end_ns
        When, in nanoseconds, in its drive's own time.
    p_from, p_to
        Where the lidar was at the first and the last of these readings, metres, map frame, (3,).
    length
        Length of the lidar's path in metres.
    readings
        Number of readings rejected.
    size
        Median length of their residuals in uT.
    passed_again
        What was read at the same place at another time, in any drive.
    bag
        Path of its drive, where there are several.
    explanations
        How well each cause explains all readings at its places, the best first; none for a map
        that does not know its errors.
    """

    sensors: tuple[str, ...]
    start_ns: int
    end_ns: int
    p_from: Vector
    p_to: Vector
    length: float
    readings: int
    size: float
    passed_again: Return
    bag: str = ""
    explanations: tuple[CauseGain, ...] = ()

    @property
    def cause(self) -> Cause | None:
        """The cause that is clearly the best; none where two explain it about as well."""
        return clear_cause(self.explanations)


@dataclass(frozen=True)
class SensorCalibration:
    """The calibration of one magnetometer and how far to trust it.

    Attributes
    ----------
    sensor
        Name.
    status, message
        How the solve ended, and a sentence about it.
    t_lidar_mag
        Position of the sensor in the lidar frame in metres, shape (3,).
    distortion
        C and H.
    R_lidar_mag
        Rotation from sensor to lidar: transpose of the proper polar factor of C, shape (3, 3).
    covariance
        Covariance of (t, C row by row, H) in m and uT, shape (15, 15); infinite on the diagonal
        for what the data cannot determine.
    rotation_covariance
        Covariance of the rotation error in the sensor frame in rad^2, shape (3, 3): true
        R_mag_lidar = exp(error) @ estimate.
    noise
        Standard deviation of the sensor's noise in microtesla that the solve used.
    residuals
        Figures of fit, absent when nothing was solved.
    undetermined
        What the data cannot determine, a sentence for each reason with the parameters by name.
    sync
        Account of the readings.
    outside_map
        Synchronised readings that were not used because the map has no data there.
    start
        Where the solve started, if that was looked for; absent where it was given.
    rejected
        Readings inside the map that did not count: no distortion explains them beside the others.
    time_offset
        Of the sensor's clock; absent where nothing was solved.
    from_priors
        What the readings leave open and only priors determine, or mostly: phrases with the
        parameters by name and what was known beforehand.
    models
        Models of the readings side by side; absent where they are not compared.
    not_compared
        Why they are not.
    moving
        What recorded numbers add to the readings; H is the offset where they are zero. Empty for a
        sensor to which no model with them is recommended.
    missing_in
        Paths of those of several drives in which nothing usable was read.
    drive_noise
        Noise on each of several drives in uT, in the order of `bags`; empty where they are alike.
    unmodelled
        How far the covariance exceeds what noise, map and poses explain.
    variance_shares
        What each cause has of the variances of t, C and H; empty where errors are not shared.
    common
        Of a suite that was calibrated from its own survey: what the errors of (t, C row by row, H,
        time offset) have in common with those of its other sensors. The covariance of two of them
        is ``common_i @ common_j.T``; it is part of ``covariance``. Shape (16, r).
    """

    sensor: str
    status: SensorStatus
    message: str
    t_lidar_mag: Vector
    distortion: Distortion
    R_lidar_mag: Matrix
    covariance: Annotated[FloatArray, InFile(tuple[(Row15,) * 15])]
    rotation_covariance: Matrix
    noise: float
    residuals: ResidualFigures | None
    undetermined: tuple[str, ...]
    sync: Annotated[SyncCounts, Field(alias="readings")]
    outside_map: int
    start: FoundStart | None = None
    rejected: int = 0
    time_offset: TimeOffset | None = None
    from_priors: tuple[str, ...] = ()
    models: ModelComparison | None = None
    not_compared: str = ""
    moving: Annotated[tuple[MovingField, ...], KeyedBy("name")] = ()
    missing_in: tuple[str, ...] = ()
    drive_noise: tuple[float, ...] = ()
    unmodelled: Unmodelled = EXPLAINED
    variance_shares: tuple[VarianceShare, ...] = ()
    common: Annotated[FloatArray, InFile(Rows16, np.atleast_2d)] | None = None

    def vector(self) -> FloatArray:
        """Return (t, C row by row, H) in m, 1 and uT, shape (15,)."""
        return np.concatenate([self.t_lidar_mag, self.distortion.vector()])

    @property
    def used(self) -> int:
        """How many readings counted."""
        return 0 if self.residuals is None else self.residuals.readings

    @property
    def inside(self) -> int:
        """How many lay inside the map: those that counted, and those that were rejected."""
        return self.used + self.rejected

    @property
    def offset_correlation(self) -> FloatArray:
        """Correlation of ``t_lidar_mag`` with the time offset, shape (3,); zero if it is held."""
        if self.time_offset is None or not self.time_offset.estimated:
            return np.zeros(3)
        sigmas = self.t_sigma * self.time_offset.sigma
        return np.asarray(self.time_offset.cross_covariance[:3] / sigmas)

    @property
    def t_sigma(self) -> FloatArray:
        """Standard deviations of ``t_lidar_mag`` in metres, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def C_sigma(self) -> FloatArray:
        """Standard deviations of the entries of C, shape (3, 3)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:12]).reshape(3, 3))

    @property
    def turn_sigma_deg(self) -> FloatArray:
        """Standard deviations of the rotation about the sensor's axes in degrees, shape (3,)."""
        return np.asarray(np.rad2deg(np.sqrt(np.diag(self.rotation_covariance))))

    @property
    def rotation_vector(self) -> FloatArray:
        """``R_lidar_mag`` as a rotation vector, shape (3,); NaN where it is not known."""
        if not np.isfinite(self.R_lidar_mag).all():
            return np.full(3, np.nan)
        return np.asarray(Rotation.from_matrix(self.R_lidar_mag).as_rotvec())

    @property
    def H_sigma(self) -> FloatArray:
        """Standard deviations of H in microtesla, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[12:]))


@dataclass(frozen=True)
class CalibrationResult(BySensor[SensorCalibration]):
    """The outcome of one calibration run over all sensors.

    Attributes
    ----------
    sensors
        One entry per magnetometer, in the order of the recording.
    iterations
        Outer steps of the one-key loop that were taken.
    uncertainty
        How the sigmas count the map's errors.
    doubts
        What speaks against the map, and therefore against the sigmas, a sentence each.
    disagreements
        Stretches of the drive over which readings were rejected, in order of time.
    bag, map
        Sources with hashes; absent when the data did not come from files. There is no one bag where
        several drives were calibrated together.
    options
        The effective options, plain values.
    versions
        Versions of the packages that computed it.
    bags
        The drives that were calibrated together, in order of time; empty for a single one.
    notes
        What is worth knowing of the drives, a sentence each.
    judgement
        The verdict with its thresholds; absent where nobody judged it.
    traces
        What its drives are recognised by, whatever file they are in.
    exact
        What counts as exact, for want of errors that are stated.
    disturbances
        What was found beside noise and the map's errors; sigmas include it.
    stated
        How large errors are of which sigmas were stated, by the readings.
    pose_duration
        How long errors of poses last; none where these are taken as exact.
    sources
        Of field that came, went or were moved since the place was mapped; the solve includes them.
    jumps
        Of H on the drive, in order of time; H is that of the end.
    unseen_warp_m
        Shifts of the drive's frame against the map's that readings leave possible, root mean square
        along each axis of the floor in metres; sigmas include them. Absent where a bend was found.
    recorded
        When each drive was recorded, and which frames its poses are of, in the order of `drives`.
    map_origin
        What the map was made from, and when; absent for a map that is not of a file.
    metrics_sha256
        Of the file with the figures that it was judged by; empty where there is none.
    report_id
        Of the file that it was written to or read from; empty where there is none, and no part of
        what is compared.
    """

    sensors: Annotated[tuple[SensorCalibration, ...], KeyedBy("sensor")]
    iterations: int
    uncertainty: Uncertainty
    doubts: tuple[str, ...]
    disagreements: tuple[Disagreement, ...]
    bag: SourceFile | None
    map: SourceFile | None
    options: dict[str, Any]
    versions: dict[str, str]
    bags: tuple[SourceFile, ...] = ()
    notes: tuple[str, ...] = ()
    judgement: Judgement | None = None
    traces: tuple[DriveTrace, ...] = ()
    exact: tuple[str, ...] = ()
    disturbances: tuple[Disturbance, ...] = ()
    sources: tuple[ChangedSource, ...] = ()
    jumps: tuple[OffsetJump, ...] = ()
    stated: tuple[StatedSize, ...] = ()
    pose_duration: PoseDuration | None = None
    unseen_warp_m: float | None = None
    recorded: tuple[RecordedDrive, ...] = ()
    map_origin: MapOrigin | None = None
    metrics_sha256: str = ""
    report_id: str = field(default="", compare=False)

    @property
    def drives(self) -> tuple[SourceFile, ...]:
        """All drives with hashes; none if the data did not come from files."""
        return self.bags or (() if self.bag is None else (self.bag,))

    @property
    def map_age_days(self) -> float | None:
        """How old the map was when the first drive began; None where dates are not known."""
        if self.map_origin is None or not self.recorded:
            return None
        return self.map_origin.age_days(self.recorded[0].when)

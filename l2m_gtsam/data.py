"""What flows through the program: frozen records of arrays, with shapes and units.

Frames: ``map``, ``lidar``, ``mag`` (one per sensor). ``T_map_lidar`` maps a point given in the
lidar frame to the map frame. Positions are in metres, magnetic field in microtesla, stamps in
integer nanoseconds.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class RigidTransform:
    """A rotation and a translation, ``p_a = R @ p_b + t``.

    Attributes
    ----------
    R
        Rotation matrix, shape (3, 3).
    t
        Translation in metres, shape (3,).
    """

    R: FloatArray
    t: FloatArray

    def inverse(self) -> "RigidTransform":
        """Return the transform from a to b."""
        return RigidTransform(self.R.T, -self.R.T @ self.t)


@dataclass(frozen=True)
class Trajectory:
    """Poses of one body in one reference frame, in order of time.

    Attributes
    ----------
    stamp_ns
        Times in nanoseconds, strictly increasing, shape (N,).
    R
        Rotations from body to reference, shape (N, 3, 3).
    p
        Positions of the body's origin in the reference frame in metres, shape (N, 3).
    frame
        Name of the reference frame ("map").
    child_frame
        Name of the body frame ("lidar").
    """

    stamp_ns: IntArray
    R: FloatArray
    p: FloatArray
    frame: str
    child_frame: str

    def __len__(self) -> int:
        return len(self.stamp_ns)


@dataclass(frozen=True)
class FieldSeries:
    """What one magnetometer reported, in its own frame and in order of time.

    Attributes
    ----------
    sensor
        Name of the sensor, unique within a recording.
    topic, frame
        Where it came from.
    stamp_ns
        Times in nanoseconds, ascending; a stamp may be repeated, shape (N,).
    field
        Magnetic field in microtesla, shape (N, 3); NaN marks a missing axis.
    """

    sensor: str
    topic: str
    frame: str
    stamp_ns: IntArray
    field: FloatArray

    def __len__(self) -> int:
        return len(self.stamp_ns)


@dataclass(frozen=True)
class SourceFile:
    """Where data came from: a file or folder and the SHA-256 of its content."""

    path: str
    sha256: str


@dataclass(frozen=True)
class Recording:
    """One drive: the lidar's poses in the map and the readings of every magnetometer."""

    trajectory: Trajectory
    series: tuple[FieldSeries, ...]
    source: SourceFile


@dataclass(frozen=True)
class Readings:
    """Readings of all sensors with the lidar's pose at each, as one batch.

    Attributes
    ----------
    sensors
        Names, in the order that ``sensor`` counts.
    sensor
        Index into ``sensors`` of each reading, ascending, shape (N,).
    stamp_ns
        Times in nanoseconds, shape (N,).
    R_map_lidar
        Rotations of the lidar at each reading, shape (N, 3, 3).
    p_map_lidar
        Positions of the lidar in the map in metres, shape (N, 3).
    field
        Measured field in the sensor's frame in microtesla, finite, shape (N, 3).
    """

    sensors: tuple[str, ...]
    sensor: IntArray
    stamp_ns: IntArray
    R_map_lidar: FloatArray
    p_map_lidar: FloatArray
    field: FloatArray

    def __len__(self) -> int:
        return len(self.sensor)

    def __getitem__(self, rows: IntArray) -> "Readings":
        return Readings(
            self.sensors,
            self.sensor[rows],
            self.stamp_ns[rows],
            self.R_map_lidar[rows],
            self.p_map_lidar[rows],
            self.field[rows],
        )

    def select(self, keep: BoolArray) -> "Readings":
        """Return the readings where ``keep``, shape (N,), is true."""
        return self[np.flatnonzero(keep)]

    def rows_of(self, index: int) -> slice:
        """Return the rows of the sensor with this index."""
        low, high = np.searchsorted(self.sensor, [index, index + 1])
        return slice(int(low), int(high))


@dataclass(frozen=True)
class SyncCounts:
    """How many readings of one sensor were kept and why the others were not."""

    received: int
    not_finite: int
    repeated: int
    outside_trajectory: int
    in_pose_gap: int
    thinned: int
    kept: int


@dataclass(frozen=True)
class Synchronised:
    """Readings with poses, and the account of what was dropped, sensor by sensor."""

    readings: Readings
    counts: tuple[SyncCounts, ...]


@dataclass(frozen=True)
class FieldSample:
    """What a map says about the field at N points.

    Attributes
    ----------
    field
        Mean in the map frame in microtesla, shape (N, 3); NaN outside the map.
    gradient
        ``gradient[n, i, j]`` = dB_i/dx_j in microtesla per metre, shape (N, 3, 3); NaN outside.
    variance
        Posterior variance per axis of the map frame in square microtesla, without sensor
        noise, shape (N, 3); infinite outside.
    inside
        Whether the map has data near the point, shape (N,).
    """

    field: FloatArray
    gradient: FloatArray
    variance: FloatArray
    inside: BoolArray


@dataclass(frozen=True)
class MapState:
    """A map as plain arrays and facts: what a map file holds.

    Attributes
    ----------
    kind
        Name of the map kind ("sliding_gp").
    arrays
        Numeric arrays only, by name.
    options
        Effective options, plain values.
    provenance
        Sources, dates, versions: plain values.
    """

    kind: str
    arrays: dict[str, npt.NDArray[Any]]
    options: dict[str, Any]
    provenance: dict[str, Any]


@dataclass(frozen=True)
class Distortion:
    """How a magnetometer sees the field: ``B_meas = C @ B_lidar + H``.

    Attributes
    ----------
    C
        Distortion matrix, shape (3, 3): rotation lidar to sensor, scale, non-orthogonality and
        soft iron.
    H
        Offset in microtesla, shape (3,).
    """

    C: FloatArray
    H: FloatArray

    @classmethod
    def identity(cls) -> "Distortion":
        """Return the distortion of an ideal sensor aligned with the lidar."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_vector(cls, vector: FloatArray) -> "Distortion":
        """Return the distortion from C row by row and H, shape (12,)."""
        return cls(vector[:9].reshape(3, 3), vector[9:])

    def vector(self) -> FloatArray:
        """Return C row by row and H, shape (12,)."""
        return np.concatenate([self.C.ravel(), self.H])

    def apply(self, b_lidar: FloatArray) -> FloatArray:
        """Return the readings for fields ``b_lidar`` in the lidar frame, shape (..., 3), uT."""
        return np.asarray(b_lidar @ self.C.T + self.H)

    def undo(self, b_meas: FloatArray) -> FloatArray:
        """Return the fields in the lidar frame for readings ``b_meas``, shape (..., 3), uT."""
        return np.asarray(np.linalg.solve(self.C, (b_meas - self.H).T).T)


@dataclass(frozen=True)
class KnownSensor:
    """A magnetometer whose place and distortion are known, as on a mapping suite or in a truth.

    Attributes
    ----------
    sensor
        Name.
    t_lidar_mag
        Position in the lidar frame in metres, shape (3,).
    distortion
        C and H.
    """

    sensor: str
    t_lidar_mag: FloatArray
    distortion: Distortion

    @classmethod
    def ideal(cls, sensor: str) -> "KnownSensor":
        """Return a sensor without distortion at the lidar's origin."""
        return cls(sensor, np.zeros(3), Distortion.identity())


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
    """Residuals ``C b + H - z`` of one sensor over the readings used, in microtesla.

    ``chi2_per_dof`` compares them with the noise that the solve assumed: 1 is consistent.
    """

    readings: int
    rms_axes: FloatArray
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

    t_lidar_mag: FloatArray
    margin: float
    runner_up: FloatArray | None

    def ambiguous(self, clear: float) -> bool:
        """Return whether the second best place leaves less than so many times as much."""
        return self.runner_up is not None and self.margin < clear


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
        When, in nanoseconds.
    p_from, p_to
        Where the lidar was at the first and the last of these readings, metres, map frame, (3,).
    length
        Way of the lidar in metres.
    readings
        Number of readings rejected.
    size
        Median length of their residuals in uT.
    passed_again
        What was read at the same place at another time.
    """

    sensors: tuple[str, ...]
    start_ns: int
    end_ns: int
    p_from: FloatArray
    p_to: FloatArray
    length: float
    readings: int
    size: float
    passed_again: Return


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
    """

    sensor: str
    status: SensorStatus
    message: str
    t_lidar_mag: FloatArray
    distortion: Distortion
    R_lidar_mag: FloatArray
    covariance: FloatArray
    rotation_covariance: FloatArray
    noise: float
    residuals: ResidualFigures | None
    undetermined: tuple[str, ...]
    sync: SyncCounts
    outside_map: int
    start: FoundStart | None = None
    rejected: int = 0

    @property
    def t_sigma(self) -> FloatArray:
        """Standard deviations of ``t_lidar_mag`` in metres, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def C_sigma(self) -> FloatArray:
        """Standard deviations of the entries of C, shape (3, 3)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:12]).reshape(3, 3))

    @property
    def H_sigma(self) -> FloatArray:
        """Standard deviations of H in microtesla, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[12:]))


@dataclass(frozen=True)
class CalibrationResult:
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
        Sources with hashes; absent when the data did not come from files.
    options
        The effective options, plain values.
    versions
        Versions of the packages that computed it.
    """

    sensors: tuple[SensorCalibration, ...]
    iterations: int
    uncertainty: Uncertainty
    doubts: tuple[str, ...]
    disagreements: tuple[Disagreement, ...]
    bag: SourceFile | None
    map: SourceFile | None
    options: dict[str, Any]
    versions: dict[str, str]

    def __getitem__(self, sensor: str) -> SensorCalibration:
        for entry in self.sensors:
            if entry.sensor == sensor:
                return entry
        raise KeyError(sensor)


@dataclass(frozen=True)
class SensorPlan:
    """What a drive will tell of one sensor.

    Attributes
    ----------
    sensor
        Name.
    t_lidar_mag
        Where it is assumed in the lidar frame in metres, shape (3,).
    readings, outside_map
        Readings that will be used, and those for which the map has no data.
    covariance
        Of (t, C row by row, H) in m and uT, shape (15, 15); infinite on the diagonal for what
        will not be determined.
    rotation_covariance
        Of the rotation error in the sensor frame in rad^2, shape (3, 3).
    undetermined
        What will not be determined, a sentence for each reason with the parameters by name.
    """

    sensor: str
    t_lidar_mag: FloatArray
    readings: int
    outside_map: int
    covariance: FloatArray
    rotation_covariance: FloatArray
    undetermined: tuple[str, ...]

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of (t, C row by row, H) in m and uT, shape (15,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Worst:
    """The parameter of a sensor that is known least, in largest useful sigmas of its kind.

    Attributes
    ----------
    undetermined
        Number of its parameters without any sigma.
    sensor
        Its name.
    parameter
        The least known of the others, by name; empty if there is none.
    sigma
        Of it in its own unit.
    share
        The same in largest useful sigmas.
    """

    undetermined: int
    sensor: str
    parameter: str
    sigma: float
    share: float

    @property
    def badness(self) -> tuple[int, float]:
        """What a better drive has less of; parameters without a sigma count first."""
        return self.undetermined, self.share


@dataclass(frozen=True)
class MotionPlan:
    """What would be known least if a motion were added to the drive."""

    motion: str
    worst: Worst


@dataclass(frozen=True)
class DrivePlan:
    """What a drive will determine and what would help.

    Attributes
    ----------
    sensors
        One entry per sensor.
    noise
        Standard deviation of the sensors' noise in uT that is assumed.
    uncertainty
        How the map's errors are counted.
    worst
        What is known least of the sensor that is known least, by itself: without what the readings
        of others tell of the map's errors.
    motions
        The same with an extra motion, the most helpful first.
    doubts
        What speaks against the map, and therefore against the sigmas, a sentence each.
    """

    sensors: tuple[SensorPlan, ...]
    noise: float
    uncertainty: Uncertainty
    worst: Worst
    motions: tuple[MotionPlan, ...]
    doubts: tuple[str, ...]

    def __getitem__(self, sensor: str) -> SensorPlan:
        for entry in self.sensors:
            if entry.sensor == sensor:
                return entry
        raise KeyError(sensor)

"""What flows through the program: frozen records of arrays, with shapes and units.

Frames: ``map``, ``lidar``, ``mag`` (one per sensor). ``T_map_lidar`` maps a point given in the
lidar frame to the map frame. Positions are in metres, magnetic field in microtesla, stamps in
integer nanoseconds.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, Self, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
FieldAndGradient = tuple[FloatArray, FloatArray]  # (N, 3) in uT and (N, 3, 3) in uT/m
ARRAYS = "(arrays)"  # in place of the path of what was made of arrays, not read from a file


@dataclass(frozen=True)
class InFile:
    """How pydantic reads an array in a file; it is written as nested lists.

    Attributes
    ----------
    type
        Type of the plain values: nested tuples of numbers, which fix the shape.
    array
        Makes the array of them.
    """

    type: Any
    array: Callable[[Any], FloatArray] = np.array

    def __get_pydantic_core_schema__(
        self, _source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            self.array,
            handler.generate_schema(self.type),
            serialization=core_schema.plain_serializer_function_ser_schema(np.ndarray.tolist),
        )


Table = TypeVar("Table")


def joined_rows(parts: Sequence[Table]) -> Table:
    """Return tables of arrays as one, the rows of each after those of the one before.

    Parameters
    ----------
    parts
        At least one, all of one dataclass. Its fields are arrays with a value for each row, such
        tables themselves, or the same in all parts. What one part lacks, all lack.
    """

    def column(values: Sequence[Any]) -> Any:
        if any(each is None for each in values):
            return None
        if is_dataclass(values[0]):
            return joined_rows(values)
        return np.concatenate(values) if isinstance(values[0], np.ndarray) else values[0]

    first: Any = parts[0]
    names = [each.name for each in fields(first)]
    whole: Table = type(first)(*(column([getattr(e, name) for e in parts]) for name in names))
    return whole


def chosen_rows(table: Table, rows: IntArray | BoolArray) -> Table:
    """Return chosen rows of a table of arrays as in ``joined_rows``."""

    def chosen(values: Any) -> Any:
        if is_dataclass(values):
            return chosen_rows(values, rows)
        return values[rows] if isinstance(values, np.ndarray) else values

    whole: Any = table
    part: Table = type(whole)(*(chosen(getattr(whole, each.name)) for each in fields(whole)))
    return part


class RowTable:
    """A table of arrays whose rows are chosen as those of an array."""

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        return chosen_rows(self, rows)


class TimedTable(RowTable):
    """One with a time for each row."""

    stamp_ns: IntArray

    def __len__(self) -> int:
        return len(self.stamp_ns)


Row3 = tuple[float, float, float]
Vector = Annotated[FloatArray, InFile(Row3)]
"""Shape (3,)."""
Matrix = Annotated[FloatArray, InFile(tuple[Row3, Row3, Row3])]
"""Shape (3, 3)."""


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
class Trajectory(TimedTable):
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
    covariance
        Covariance of each pose's error, shape (N, 6, 6), or None where it is unknown. The error
        is a right perturbation in GTSAM's order, ``T_true = T @ Exp(error)``: a rotation in
        radians, then a translation in metres, both along the axes of the body.
    """

    stamp_ns: IntArray
    R: FloatArray
    p: FloatArray
    frame: str
    child_frame: str
    covariance: FloatArray | None = None

    def pose(self, row: int) -> RigidTransform:
        """Return one of the poses."""
        return RigidTransform(self.R[row], self.p[row])


@dataclass(frozen=True)
class FieldSeries(TimedTable):
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


@dataclass(frozen=True)
class ScalarSeries(TimedTable):
    """A number that was recorded along a drive: a motor's current, a speed, a duty cycle.

    Attributes
    ----------
    name
        What it is called, unique within a recording.
    topic
        Where it came from.
    stamp_ns
        Times in nanoseconds, strictly increasing, shape (M,).
    value
        Finite, in the unit of the topic times the scale that was asked for, shape (M,).
    """

    name: str
    topic: str
    stamp_ns: IntArray
    value: FloatArray


@dataclass(frozen=True)
class SourceFile:
    """Where data came from: a file or folder and the SHA-256 of its content."""

    path: str
    sha256: str


def same_content(one: SourceFile | None, other: SourceFile | None) -> bool:
    """Return whether both are there and have the same content, wherever they lie."""
    return one is not None and other is not None and one.sha256 == other.sha256


@dataclass(frozen=True)
class Recording:
    """One drive, or several joined by ``joining.joined``.

    Attributes
    ----------
    trajectory
        The lidar's poses in the map.
    series
        Readings of every magnetometer.
    source
        Where it came from.
    scalars
        Numbers that were recorded.
    drives
        What it was joined from, each in its own time, in order of time; empty for one drive.
    moved_ns
        What was added to the stamps of each drive so that none overlaps another, nanoseconds.
    notes
        What is worth a warning, a sentence each: where its poses come from if the bag has none, or
        several topics with some, or a clock that was set.
    origins
        What else it was made from, a sentence each with the hash of the file.
    poses
        The file with its poses; absent where they are in the source.
    """

    trajectory: Trajectory
    series: tuple[FieldSeries, ...]
    source: SourceFile
    scalars: tuple[ScalarSeries, ...] = ()
    drives: tuple["Recording", ...] = ()
    moved_ns: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    origins: tuple[str, ...] = ()
    poses: SourceFile | None = None

    @property
    def parts(self) -> tuple["Recording", ...]:
        """Its drives; itself if it is one."""
        return self.drives or (self,)


@dataclass(frozen=True)
class LidarMotion(RowTable):
    """How the lidar moves at N readings, and when their poses were taken.

    Attributes
    ----------
    twist_lidar
        Angular velocity in rad/s and linear velocity in m/s, both in the lidar frame, shape (N, 6).
    acceleration_lidar
        How these grow, rad/s^2 and m/s^2, in the frame of the lidar at the reading, shape (N, 6).
    offset
        Time offset in seconds: the poses are those at stamp + offset, shape (N,).
    """

    twist_lidar: FloatArray
    acceleration_lidar: FloatArray
    offset: FloatArray

    @classmethod
    def steady(cls, twist_lidar: FloatArray) -> "LidarMotion":
        """Return motion at constant velocities, shape (N, 6), with poses at the stamps."""
        return cls(twist_lidar, np.zeros_like(twist_lidar), np.zeros(len(twist_lidar)))


@dataclass(frozen=True)
class Readings(TimedTable):
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
    motion
        How the lidar moves there, if that is known: without it no time offset can be.
    pose_root
        Square roots L of the covariances of the poses' errors, ``true = measured Exp(L u)``, in the
        lidar frame, rotation (rad) before translation (m), shape (N, 6, 6); absent for exact poses.
    regressors
        Recorded numbers whose field may be part of the readings, each in its own unit, shape
        (N, K); zero where they do not act on a sensor, absent where none were recorded.
    drive
        Which drive each is of, ascending for each sensor, shape (N,); absent where there is one.
    relative_noise
        How large the noise of each is beside its sensor's, shape (N,); absent where it is one.
    """

    sensors: tuple[str, ...]
    sensor: IntArray
    stamp_ns: IntArray
    R_map_lidar: FloatArray
    p_map_lidar: FloatArray
    field: FloatArray
    motion: LidarMotion | None = None
    pose_root: FloatArray | None = None
    regressors: FloatArray | None = None
    drive: IntArray | None = None
    relative_noise: FloatArray | None = None

    @property
    def of_drive(self) -> IntArray:
        """Which drive each is of, shape (N,); 0 where there is one."""
        return np.zeros(len(self), dtype=np.int64) if self.drive is None else self.drive

    @property
    def noise_ratio(self) -> FloatArray:
        """How large the noise of each is beside its sensor's, shape (N,)."""
        return np.ones(len(self)) if self.relative_noise is None else self.relative_noise

    def noise(self, of_sensors: FloatArray) -> FloatArray:
        """Return the noise of each in uT, shape (N,), by that of the S sensors, shape (S,)."""
        return np.asarray(of_sensors[self.sensor] * self.noise_ratio)

    def select(self, keep: BoolArray) -> "Readings":
        """Return the readings where ``keep``, shape (N,), is true."""
        return self[np.flatnonzero(keep)]

    def rows_of(self, index: int) -> slice:
        """Return the rows of the sensor with this index."""
        low, high = np.searchsorted(self.sensor, [index, index + 1])
        return slice(int(low), int(high))

    def alone(self, index: int) -> "Readings":
        """Return the readings of the sensor with this index, as of the only one."""
        own = self[np.arange(len(self))[self.rows_of(index)]]
        return replace(own, sensors=(self.sensors[index],), sensor=np.zeros_like(own.sensor))


@dataclass(frozen=True)
class SaturatedAxis:
    """A limit of a sensor's range that readings exceed.

    Attributes
    ----------
    axis
        "x", "y" or "z" of the sensor.
    limit
        The value that is reported beyond it, uT.
    readings, of
        How many readings at different places have it, and how many there are.
    """

    axis: str
    limit: float
    readings: int
    of: int

    @property
    def share(self) -> float:
        """Share of the readings at the limit."""
        return self.readings / self.of


@dataclass(frozen=True)
class SyncCounts:
    """How many readings of one sensor were kept and why the others were not.

    ``limits`` are those of its range that the ``saturated`` readings exceed. Those ``elsewhere``
    are in parts of a large map that do not count.
    """

    received: int
    not_finite: int
    repeated: int
    outside_trajectory: int
    in_pose_gap: int
    thinned: int
    kept: int
    without_regressor: int = 0
    elsewhere: int = 0
    saturated: int = 0
    limits: tuple[SaturatedAxis, ...] = ()


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

    def select(self, keep: BoolArray) -> "FieldSample":
        """Return what it says at some of the points, shape (N,)."""
        return chosen_rows(self, keep)


@dataclass(frozen=True)
class LidarMap:
    """What a lidar saw of a mapped place, and where it was then.

    Attributes
    ----------
    points
        In the map frame in metres, shape (N, 3).
    R, p
        Rotations (K, 3, 3) and positions (K, 3) in metres of the lidar in the map, along the
        mapping drives, the first of them first.
    """

    points: FloatArray
    R: FloatArray
    p: FloatArray


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
    lidar
        What a lidar saw of the place, if that was saved with it.
    """

    kind: str
    arrays: dict[str, npt.NDArray[Any]]
    options: dict[str, Any]
    provenance: dict[str, Any]
    lidar: LidarMap | None = None


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

    C: Matrix
    H: Vector

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
class CorrectedField:
    """Readings of one sensor with its distortion undone.

    Attributes
    ----------
    field
        In the axes of the lidar in microtesla, shape (N, 3); NaN where it is not known.
    covariance
        Of each, in square microtesla, shape (N, 3, 3); NaN where the field is.
    """

    field: FloatArray
    covariance: FloatArray


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
    time_offset
        Of its clock in seconds: a reading's pose is that at stamp + offset.
    covariance
        Of (t, C row by row, H, time offset) in m, 1, uT and s, shape (16, 16); absent where they
        count as exact.
    common
        What its errors have in common with those of the other sensors of its file: the covariance
        of two of them is ``common_i @ common_j.T``, shape (16, r). Absent where it is nothing.
    """

    sensor: str
    t_lidar_mag: FloatArray
    distortion: Distortion
    time_offset: float = 0.0
    covariance: FloatArray | None = None
    common: FloatArray | None = None

    @classmethod
    def ideal(cls, sensor: str) -> "KnownSensor":
        """Return a sensor without distortion at the lidar's origin."""
        return cls(sensor, np.zeros(3), Distortion.identity())

    @property
    def is_ideal(self) -> bool:
        """Whether nothing is known of it: no distortion, at the lidar's origin, no sigmas."""
        ideal = KnownSensor.ideal(self.sensor).vector()
        return self.covariance is None and np.array_equal(self.vector(), ideal)

    def vector(self) -> FloatArray:
        """Return (t, C row by row, H) in m, 1 and uT, shape (15,)."""
        return np.concatenate([self.t_lidar_mag, self.distortion.vector()])

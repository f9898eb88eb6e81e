"""What is taken out of messages: one table of types, covariances, and growing buffers."""

from array import array
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Trajectory
from l2m_gtsam.geometry import from_ros
from l2m_gtsam.storage.tf import Link
from l2m_gtsam.storage.units import Unit, odd_poses, readable

SIZE = 36
# Asymmetry and negative eigenvalues that rounding explains, also in single precision, relative
# to the largest variance of positions and of rotations.
ROUNDING = 1e-6
# Drivers write large numbers for what they do not know, most often 1e3 to 1e6: nobody measures a
# map's field with poses that are worse than this, in metres and radians.
MOST_POSITION = 100.0
MOST_ROTATION = 1.0
LATEST_US = 9_000_000_000_000_000  # nanoseconds after it do not fit into 64 bits


@dataclass
class CovarianceBuffer:
    """Covariances of poses as they come; one that repeats the one before is kept once."""

    values: "array[float]" = field(default_factory=lambda: array("d", bytes(8 * SIZE)))
    row: "array[int]" = field(default_factory=lambda: array("q"))

    def add(self, covariance: Any) -> None:
        """Append the covariance of one pose: 36 numbers, or None where a type carries none."""
        if covariance is None:
            self.row.append(0)
            return
        numbers = np.asarray(covariance, dtype=np.float64).ravel()
        if len(numbers) != SIZE:
            numbers = np.full(SIZE, np.nan)
        new = numbers.tobytes()
        if new != self.values[-SIZE:].tobytes():
            self.values.frombytes(new)
        self.row.append(len(self.values) // SIZE - 1)

    def at(self, poses: IntArray) -> FloatArray | None:
        """Return the covariances of poses by their index, in ROS' order and axes.

        Returns
        -------
        Symmetric matrices, shape (N, 6, 6), or None unless every one of them is usable: where
        some errors are unknown, the others would be no measure of the whole.
        """
        matrices, rows = self._matrices(), np.array(self.row, dtype=np.int64)[poses]
        if not usable(matrices)[rows].all():
            return None
        return np.asarray(((matrices + matrices.swapaxes(1, 2)) / 2)[rows])

    @property
    def are_known(self) -> bool:
        """Whether there are poses, and each has a covariance that is usable."""
        rows = np.array(self.row, dtype=np.int64)
        return bool(len(rows) and usable(self._matrices())[rows].all())

    def account(self) -> str:
        """Return what can be said of all covariances together, as half a sentence."""
        matrices, rows = self._matrices(), np.array(self.row, dtype=np.int64)
        if not matrices[np.unique(rows)].any():
            return "their covariance is unknown: all zero"
        wrong = int(np.sum(~usable(matrices)[rows]))
        if wrong:
            return f"their covariance is unknown: not usable in {wrong} of {len(rows)}"
        return "with covariance"

    def _matrices(self) -> FloatArray:
        """Return the distinct matrices, the first of them zero, shape (K, 6, 6)."""
        return np.array(self.values, dtype=np.float64).reshape(-1, 6, 6)


def usable(covariance: FloatArray) -> BoolArray:
    """Mark covariances that state an error: finite, not zero, not a placeholder, semidefinite.

    Parameters
    ----------
    covariance
        Matrices in ROS' order (x, y, z, rx, ry, rz), rad and m, shape (K, 6, 6).

    Returns
    -------
    Shape (K,).
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    most = np.array([MOST_POSITION, MOST_ROTATION])[:, None] ** 2
    plain = np.isfinite(covariance).all(axis=(1, 2)) & covariance.any(axis=(1, 2))
    plain &= (np.abs(variance) <= most).all(axis=(1, 2))
    good = np.flatnonzero(plain)
    largest = np.sqrt(np.abs(variance[good]).max(axis=2))
    scale = np.repeat(np.where(largest > 0, largest, 1.0), 3, axis=1)
    with np.errstate(over="ignore"):  # a huge covariance beside a tiny variance
        scaled = covariance[good] / scale[:, :, None] / scale[:, None, :]
    # Also keeps the eigenvalues from numbers that they cannot be found for.
    bounded = (np.abs(scaled) <= 1 + ROUNDING).all(axis=(1, 2))
    good, scaled = good[bounded], scaled[bounded]
    asymmetry = np.abs(scaled - scaled.swapaxes(1, 2)).max(axis=(1, 2))
    lowest = np.linalg.eigvalsh(scaled)[:, 0]
    found = np.zeros(len(covariance), dtype=np.bool_)
    found[good] = (asymmetry <= ROUNDING) & (lowest >= -ROUNDING)
    return found


TRANSFORM_TYPE = "geometry_msgs/msg/TransformStamped"
TF_TYPE = "tf2_msgs/msg/TFMessage"
TF_TYPES = (TF_TYPE, "tf/msg/tfMessage")


PATH_TYPE = "nav_msgs/msg/Path"
PX4_POSE_TYPE = "px4_msgs/msg/VehicleOdometry"
CSV_POSE_TYPE = "csv/Pose"


class Position(NamedTuple):
    """A position in metres."""

    x: float
    y: float
    z: float


class Orientation(NamedTuple):
    """A quaternion."""

    x: float
    y: float
    z: float
    w: float


@dataclass(frozen=True)
class RawPose:
    """A pose as written in a message; types without a covariance have None for it."""

    position: Any
    orientation: Any
    child_frame: str
    covariance: Any = None


# Types that carry poses, in the order of preference when a bag has several.
POSE_TYPES: dict[str, Callable[[Any], RawPose]] = {
    "nav_msgs/msg/Odometry": lambda m: RawPose(
        m.pose.pose.position, m.pose.pose.orientation, m.child_frame_id, m.pose.covariance
    ),
    "geometry_msgs/msg/PoseStamped": lambda m: RawPose(m.pose.position, m.pose.orientation, ""),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: RawPose(
        m.pose.pose.position, m.pose.pose.orientation, "", m.pose.covariance
    ),
    TRANSFORM_TYPE: lambda m: RawPose(
        m.transform.translation, m.transform.rotation, m.child_frame_id
    ),
    CSV_POSE_TYPE: lambda m: m,  # a RawPose
    PX4_POSE_TYPE: lambda m: px4_pose(m.position, m.q),
}
# A path comes last: some repeat where a vehicle was, others are plans of where it shall go.
ALL_POSE_TYPES = (*POSE_TYPES, PATH_TYPE)


def stamped_poses(content: Any, msgtype: str) -> Iterator[tuple[Any, RawPose]]:
    """Yield what has a stamp in a message, and its pose; nothing of types without poses."""
    if msgtype in TF_TYPES:
        yield from ((item, POSE_TYPES[TRANSFORM_TYPE](item)) for item in content.transforms)
    elif msgtype in POSE_TYPES:
        yield content, POSE_TYPES[msgtype](content)


def ends_of(stamped: Any, pose: RawPose, msgtype: str) -> tuple[str, str]:
    """Return the frames of a pose, parent and child; "map" and "lidar" where it names none."""
    if msgtype in TF_TYPES:
        return frame_of(stamped).lstrip("/"), pose.child_frame.lstrip("/")
    frame = frame_of(stamped) if hasattr(stamped, "header") else "map"
    return frame, pose.child_frame or "lidar"


def bodies_fault(bodies: Collection[tuple[str, str]]) -> str:
    """Return what is wrong with poses on one topic, by parent and child, if not of one body."""
    if len(bodies) <= 1:
        return ""
    ends = ", ".join(f"{parent} > {child}" for parent, child in sorted(bodies)[:10])
    return f"a topic must track one body, this tracks: {ends}"


def px4_pose(position: Any, q: Any) -> RawPose:
    """Return a pose of PX4 in the axes of ROS (REP-103): east, north, up; forward, left, up.

    ``R_enu_flu = E R_ned_frd F`` with half turns E about the horizontal (1, 1, 0) and F about x.

    Parameters
    ----------
    position
        North, east, down, or forward, right, down, in metres.
    q
        From the body's axes forward, right, down; w first.
    """
    north, east, down = (float(value) for value in position)
    w, x, y, z = (float(value) for value in q)
    half = 0.5**0.5
    turned = Orientation(half * (x + y), half * (x - y), half * (w - z), half * (w + z))
    return RawPose(Position(east, north, -down), turned, "")


def header_ns(message: Any) -> int:
    """Return the header's stamp in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_of(message: Any, record_ns: int) -> int:
    """Return the stamp of a message in nanoseconds: its header's, or PX4's.

    Parameters
    ----------
    message
        Of any type.
    record_ns
        When it was recorded, which counts where it has no stamp.
    """
    if hasattr(getattr(message, "header", None), "stamp"):
        return header_ns(message)
    taken_us = getattr(message, "timestamp_sample", 0) or getattr(message, "timestamp", 0)
    if isinstance(taken_us, int) and 0 < taken_us < LATEST_US:
        return 1000 * taken_us
    return record_ns


def frame_of(message: Any) -> str:
    """Return the frame of a message's header; empty where it has none."""
    return str(getattr(getattr(message, "header", None), "frame_id", ""))


@dataclass
class StampBuffer:
    """Times of messages as they come, nanoseconds."""

    header_ns: "array[int]" = field(default_factory=lambda: array("q"))
    record_ns: "array[int]" = field(default_factory=lambda: array("q"))

    def add(self, header: int, record: int) -> None:
        """Append the two times of one message."""
        self.header_ns.append(header)
        self.record_ns.append(record)

    def header(self) -> IntArray:
        """Return the header stamps, shape (N,)."""
        return np.array(self.header_ns, dtype=np.int64)

    def record(self) -> IntArray:
        """Return the record times, shape (N,)."""
        return np.array(self.record_ns, dtype=np.int64)


@dataclass
class FieldBuffer:
    """Readings of one sensor as they come; ``unit`` is the one that their type prescribes."""

    topic: str
    frame: str
    unit: Unit | None = None
    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))

    def add(self, stamp_ns: int, reading: tuple[float, float, float]) -> None:
        """Append one reading as it is written."""
        self.stamp_ns.append(stamp_ns)
        self.values.extend(reading)

    def stamps(self) -> IntArray:
        """Return the stamps, shape (N,)."""
        return np.array(self.stamp_ns, dtype=np.int64)

    def field(self) -> FloatArray:
        """Return the readings as they were written, NaN for what no sensor reads, shape (N, 3)."""
        return readable(np.array(self.values, dtype=np.float64).reshape(-1, 3))


@dataclass
class PoseBuffer:
    """Poses of one body as they come."""

    frame: str
    child_frame: str
    static: bool = False
    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    covariances: CovarianceBuffer = field(default_factory=CovarianceBuffer)

    def add(self, stamp_ns: int, position: Any, orientation: Any, covariance: Any = None) -> None:
        """Append one pose."""
        p, q = position, orientation
        self.stamp_ns.append(stamp_ns)
        self.values.extend((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
        self.covariances.add(covariance)

    def trajectory(self) -> Trajectory:
        """Return the poses of ``link`` with their covariances, if all of them have a usable one.

        Raises
        ------
        ValueError
            As in ``link``.
        """
        link = self.link()
        stated = self.covariances.at(self._used())
        covariance = None if stated is None else from_ros(stated, link.R)
        return Trajectory(link.stamp_ns, link.R, link.p, link.parent, link.child, covariance)

    def link(self) -> Link:
        """Return the finite poses in order of time, the first of each stamp.

        Raises
        ------
        ValueError
            An orientation is no rotation, a position is out of range, or no pose is finite.
        """
        used = self._used()
        stamps, rows = np.array(self.stamp_ns, dtype=np.int64)[used], self._rows()[used]
        if wrong := odd_poses(rows[:, :3], rows[:, 3:]):
            raise ValueError(wrong)
        R = Rotation.from_quat(rows[:, 3:]).as_matrix().reshape(-1, 3, 3)
        if self.static:  # the last one published holds, whenever
            return Link(self.frame, self.child_frame, stamps[:0], R[-1:], rows[-1:, :3])
        return Link(self.frame, self.child_frame, stamps, R, rows[:, :3])

    def _used(self) -> IntArray:
        """Return the indices of the finite poses in order of time, the first of each stamp."""
        finite = np.flatnonzero(np.isfinite(self._rows()).all(axis=1))
        if not len(finite):
            raise ValueError("no pose is finite")
        _, first = np.unique(np.array(self.stamp_ns, dtype=np.int64)[finite], return_index=True)
        return finite[first]

    def _rows(self) -> FloatArray:
        """Return positions and quaternions as they were written, shape (N, 7)."""
        return np.array(self.values, dtype=np.float64).reshape(-1, 7)

"""Scans of rooms made of axis-aligned boxes, by casting rays: what a 32-beam lidar would see."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.records.scans import Scan

START_NS = 1_700_000_000_000_000_000
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Room:
    """A box seen from inside, and boxes that stand in it, each as its two opposite corners."""

    walls: Box
    boxes: tuple[Box, ...] = ()

    def distances(self, origin: FloatArray, rays: FloatArray) -> FloatArray:
        """Return how far unit rays, shape (N, 3), go from one place inside or N, shape (N,)."""
        _, far = _slabs(self.walls, origin, rays)
        for box in self.boxes:
            enter, leave = _slabs(box, origin, rays)
            far = np.where((enter > 0) & (enter < leave), np.minimum(far, enter), far)
        return far


ROOM = Room(
    ((-6.0, -5.0, 0.0), (8.0, 7.0, 3.5)),
    (
        ((3.0, 2.0, 0.0), (4.0, 3.5, 2.0)),
        ((-4.0, -3.0, 0.0), (-3.4, 1.0, 1.2)),
        ((5.5, -4.0, 0.0), (6.0, -3.0, 3.5)),
    ),
)
# Nothing in it tells a place along x from another: its ends are out of range.
CORRIDOR = Room(((-500.0, -1.5, 0.0), (500.0, 1.5, 2.8)))


def directions(beams: int = 32, columns: int = 180) -> FloatArray:
    """Return the rays of a spinning lidar, +-20 degrees up and down, shape (beams * columns, 3)."""
    up, around = np.meshgrid(
        np.deg2rad(np.linspace(-20, 20, beams)),
        np.linspace(0, 2 * np.pi, columns, endpoint=False),
        indexing="ij",
    )
    rays = [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
    return np.stack(rays, axis=-1).reshape(-1, 3)


def seen(
    room: Room,
    pose: RigidTransform,
    rng: np.random.Generator,
    noise_m: float = 0.01,
    max_range_m: float = 30.0,
    rays: FloatArray | None = None,
) -> FloatArray:
    """Return what a lidar at a pose sees in its own frame, shape (N, 3), metres."""
    rays = directions() if rays is None else rays
    far = room.distances(pose.t, rays @ pose.R.T)
    points = rays * (far + noise_m * rng.standard_normal(len(far)))[:, None]
    return points[far <= max_range_m]


def scans(
    room: Room, trajectory: Trajectory, rng: np.random.Generator, noise_m: float = 0.01
) -> Iterator[Scan]:
    """Yield a scan, taken at once, at each pose of a trajectory."""
    for k, stamp in enumerate(trajectory.stamp_ns):
        pose = RigidTransform(trajectory.R[k], trajectory.p[k])
        yield Scan(int(stamp), seen(room, pose, rng, noise_m))


def swept(
    room: Room, trajectory: Trajectory, twist: FloatArray, seconds: float, columns: int = 180
) -> Iterator[Scan]:
    """Yield exact scans whose columns a lidar of constant twist measures one after the other."""
    rays = directions(columns=columns)
    turn = np.tile(np.arange(columns) / columns * seconds, len(rays) // columns)
    for k, stamp in enumerate(trajectory.stamp_ns):
        R, p = trajectory.R[k], trajectory.p[k]
        R_ray = R @ Rotation.from_rotvec(turn[:, None] * twist[:3]).as_matrix()
        far = room.distances(
            p + turn[:, None] * (R @ twist[3:]), np.einsum("nij,nj->ni", R_ray, rays)
        )
        yield Scan(int(stamp), rays * far[:, None], turn)


def round_trip(count: int = 60, rate_hz: float = 10.0, speed: float = 0.8) -> Trajectory:
    """Return a drive around a circle of 1.5 m, heading along it, with a little pitch and roll."""
    seconds = np.arange(count) / rate_hz
    angle = speed * seconds / 1.5
    p = np.column_stack([1.5 * np.cos(angle), 1.5 * np.sin(angle), np.full(count, 1.0)])
    tilt = 0.02 * np.sin(2 * angle)
    R = Rotation.from_euler("ZYX", np.column_stack([angle + np.pi / 2, tilt, -tilt])).as_matrix()
    return Trajectory(START_NS + (seconds * 1e9).astype(np.int64), R, p, "map", "lidar")


def straight(count: int = 20, rate_hz: float = 10.0, speed: float = 1.0) -> Trajectory:
    """Return a drive along x."""
    seconds = np.arange(count) / rate_hz
    p = np.column_stack([speed * seconds, np.zeros(count), np.full(count, 1.0)])
    R = np.broadcast_to(np.eye(3), (count, 3, 3))
    return Trajectory(START_NS + (seconds * 1e9).astype(np.int64), R, p, "map", "lidar")


def rows(trajectory: Trajectory, numbers: Iterable[int]) -> Trajectory:
    """Return some of the poses of a trajectory."""
    return trajectory[np.fromiter(numbers, dtype=np.int64)]


def _slabs(box: Box, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where rays enter and leave a box, shape (N,) each; a ray along a face is nudged."""
    slope = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    to = (np.array(box)[:, None, :] - origin) / slope
    return to.min(axis=0).max(axis=1), to.max(axis=0).min(axis=1)

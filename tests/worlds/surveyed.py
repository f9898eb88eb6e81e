"""Fields that are known everywhere, as maps that know where they were surveyed."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSample, FloatArray, Recording, Trajectory
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.maps.field_map import FieldMap, masked
from l2m_gtsam.maps.training import TrainingSet
from tests.drives.slam import RATE_HZ, SPEED, ahead
from tests.worlds.exact import DipoleWorld
from tests.worlds.quick_maps import quick

REACH = 0.4  # metres
SIGMA = 0.05  # uT, what the map says of itself
HEIGHTS = (0.1, 0.5, 0.9)  # metres
ROOM = 4.5  # metres to each side of its middle
NOISE = 0.2  # uT


@dataclass(frozen=True)
class SurveyedWorld:
    """The exact field near readings of a survey."""

    world: DipoleWorld
    readings: TrainingSet

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        return self.world.field_and_gradient(points)

    def query(self, points: FloatArray, /) -> FieldSample:
        field, gradient = self.field_and_gradient(points)
        away, _ = self.readings.tree.query(points, distance_upper_bound=REACH)
        variance = np.full_like(field, SIGMA**2)
        return masked(FieldSample(field, gradient, variance, np.isfinite(away)))


def surveyed(world: DipoleWorld, *rooms: float) -> SurveyedWorld:
    """Return the world as a map of rooms about these x (m), or about x = 0, at three heights."""
    lines = np.arange(-ROOM, ROOM + 0.1, 0.45)
    x, y = (axis.ravel() for axis in np.meshgrid(lines, lines))
    one = np.concatenate([np.column_stack([x, y, np.full(len(x), z)]) for z in HEIGHTS])
    points = np.concatenate([one + np.array([room, 0.0, 0.0]) for room in rooms or (0.0,)])
    field, _ = world.field_and_gradient(points)
    return SurveyedWorld(world, TrainingSet(points, field, np.ones(len(points))))


def strange_hall(seed: int, count: int = 16) -> DipoleWorld:
    """Return a hall of about 5 uT of steel: as strong as a building's."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-5, -5, 0], [5, 5, 1], (count, 3))
    positions[:, 2] = np.where(rng.random(count) < 0.5, -0.6, 2.5)
    return DipoleWorld(np.array([22.0, 3.0, -38.0]), positions, rng.normal(0, 120, (count, 3)))


def wandering(rng: np.random.Generator, seconds: float, within: float = 3.2) -> Trajectory:
    """Return a drive from anywhere in a room, with a little roll, pitch and heave."""
    at = np.arange(0, seconds, 1 / RATE_HZ)
    p, place = np.zeros((len(at), 3)), rng.uniform(-within, within, 2)
    yaw, rate = rng.uniform(-np.pi, np.pi), 0.0
    for k in range(len(at)):
        p[k, :2] = place
        rate = 0.95 * rate + rng.normal(0, 0.12)
        turn = rate
        if np.abs(place).max() > within:  # back to the middle
            off = (np.arctan2(-place[1], -place[0]) - yaw + np.pi) % (2 * np.pi) - np.pi
            turn = np.clip(2 * off, -1.5, 1.5)
        yaw += turn / RATE_HZ
        place = place + SPEED / RATE_HZ * np.array([np.cos(yaw), np.sin(yaw)])
    p[:, 2] = 0.5 + 0.03 * np.sin(1.3 * at)
    return ahead(at, p)


def in_odometry(recording: Recording, rng: np.random.Generator) -> Recording:
    """Return a recording whose poses are in a frame of odometry's own; its z axis is up."""
    R = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)).as_matrix()
    poses, away = recording.trajectory, rng.uniform(-20, 20, 3)
    poses = replace(poses, R=R @ poses.R, p=poses.p @ R.T + away, frame="odom")
    return replace(recording, trajectory=poses)


def survey(world: DipoleWorld, rng: np.random.Generator) -> FieldMap:
    """Return a map from readings at three heights over the middle of the hall."""
    lines = np.arange(-4.4, 4.5, 0.3)
    x, y = (axis.ravel() for axis in np.meshgrid(lines, lines))
    points = np.column_stack([x, y, rng.choice([0.2, 0.5, 0.9], len(x))])
    points += rng.normal(0, 0.03, points.shape)
    field, _ = world.field_and_gradient(points)
    return build_map(points, field + NOISE * rng.normal(size=field.shape), quick("harmonic"))

"""Random readings, poses and values for tests of factors."""

from dataclasses import replace
from typing import TypeVar

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import (
    Calibrations,
    D,
    KeyPoseReadings,
    M,
    MagneticReadings,
    PoseMotion,
    S,
    StepError,
    T,
    Whitening,
    X,
)
from l2m_gtsam.data import FloatArray, Readings
from tests.worlds.exact import DipoleWorld

AnyReadings = TypeVar("AnyReadings", MagneticReadings, KeyPoseReadings)

SENSORS = 2
MODES = 4  # of a map's error


def as_magnetic(readings: Readings) -> MagneticReadings:
    return MagneticReadings(
        readings.sensor, readings.R_map_lidar, readings.p_map_lidar, readings.field
    )


def with_motion(readings: AnyReadings, seed: int) -> AnyReadings:
    """Return readings of a lidar that turns by up to 1 rad/s and moves by up to 2 m/s."""
    rng, n = np.random.default_rng(seed), len(readings)
    twist = np.hstack([rng.uniform(-1, 1, (n, 3)), rng.uniform(-2, 2, (n, 3))])
    return replace(readings, motion=PoseMotion(twist, rng.uniform(-0.02, 0.02, n)))


def random_values(seed: int, sensors: int) -> gtsam.Values:
    rng = np.random.default_rng(seed)
    values = gtsam.Values()
    for i in range(sensors):
        values.insert(T(i), rng.uniform(-0.5, 0.5, 3))
        C = Rotation.random(rng=rng).as_matrix() + rng.normal(0, 0.2, (3, 3))
        values.insert(D(i), np.concatenate([C.ravel(), rng.normal(0, 20, 3)]))
        values.insert(S(i), float(rng.uniform(-0.05, 0.05)))
    return values


class CountingWorld:
    """A map that counts how often it is asked."""

    def __init__(self, world: DipoleWorld) -> None:
        self.world, self.calls = world, 0

    def field_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        self.calls += 1
        return self.world.field_and_gradient(points)


def random_carried(seed: int, key_poses: int = 2, each: int = 4) -> KeyPoseReadings:
    """Return readings within half a metre of their key poses, the sensors in turn."""
    rng, n = np.random.default_rng(seed), key_poses * each
    return KeyPoseReadings(
        key_pose=np.repeat(np.arange(key_poses), each),
        sensor=np.arange(n) % SENSORS,
        R_key_lidar=Rotation.from_rotvec(rng.normal(0, 0.3, (n, 3))).as_matrix(),
        p_key_lidar=rng.normal(0, 0.3, (n, 3)),
        fraction=rng.uniform(size=n),
        field=rng.normal(0, 30, (n, 3)),
    )


def on(readings: KeyPoseReadings, key_pose: int) -> KeyPoseReadings:
    return readings[np.flatnonzero(readings.key_pose == key_pose)]


def values_for(seed: int, key_poses: int = 2) -> gtsam.Values:
    """Return random poses over the floor of the hall, calibrations and weights."""
    values, rng = random_values(seed, SENSORS), np.random.default_rng(seed + 1)
    for k in range(key_poses):
        R = gtsam.Rot3(Rotation.random(rng=rng).as_matrix())
        p = np.append(rng.uniform(-4, 4, 2), 0.8 + 0.1 * rng.normal())
        values.insert(X(k), gtsam.Pose3(R, p))
    values.insert(M(7), rng.normal(size=MODES))
    return values


def calibrations(values: gtsam.Values) -> Calibrations:
    return Calibrations(
        np.stack([values.atPoint3(T(i)) for i in range(SENSORS)]),
        np.stack([values.atVector(D(i)) for i in range(SENSORS)]),
        np.array([values.atDouble(S(i)) for i in range(SENSORS)]),
    )


def whitenings(seed: int, n: int) -> Whitening:
    """Return random ones, with two errors that the readings have in common."""
    rng = np.random.default_rng(seed)
    own = rng.normal(size=(n, 3, 3)) + 3 * np.eye(3)
    return Whitening.with_errors(own, rng.normal(size=(n, 3, 2)))


def step_error(seed: int, n: int, values: gtsam.Values) -> StepError:
    """Return what the readings on key pose 1 feel of a step to 2 that is off by decimetres."""
    rng = np.random.default_rng(seed + 2)
    off = gtsam.Pose3.Expmap(rng.normal(0, 0.2, 6))
    way = values.atPose3(X(1)).between(values.atPose3(X(2)))
    return StepError(1, way.compose(off), rng.normal(0, 20, (n, 3, 6)))


def drawn_step(rng: np.random.Generator) -> tuple[gtsam.Pose3, gtsam.Values]:
    """Return a step, and key poses 4 and 5, which are about so far apart."""
    step = gtsam.Pose3.Expmap(rng.normal(0, [0.5] * 3 + [1.0] * 3))
    first, values = gtsam.Pose3.Expmap(rng.normal(size=6)), gtsam.Values()
    values.insert(X(4), first)
    values.insert(X(5), first.compose(step).retract(rng.normal(0, 0.2, 6)))
    return step, values

"""Covariances of a path by second derivatives of its density, against dense ones."""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_factors import V, X
from l2m_gtsam.data import FieldSeries, FloatArray, Recording, SourceFile, Trajectory
from l2m_gtsam.maps.potential import PotentialHyperparameters
from l2m_gtsam.slam.drive import EXACT_START, Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.pose_graph import drive_values, odometry_graph
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.path_density import PathDensity
from l2m_gtsam.slam.unknown_field.path_information import (
    PathNeighbourhood,
    path_information,
    path_readings,
)
from l2m_gtsam.slam.unknown_field.sensor_noise import NoiseInformation, SensorNoise
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.whole_field import WholePrior
from l2m_gtsam.studies.slam.methods import as_recorded

NOISE = SensorNoise(0.3, 0.5, 2.0)
SIDE = 2e-3  # of second differences, in sigmas
COUNT = 14
FREE = 1e-3  # sum of the sigmas of a sensor that is not taken as exact


@dataclass(frozen=True)
class Step:
    """A drive of one step with readings on it, and its estimate."""

    drive: Drive
    poses: list[gtsam.Pose3]
    values: gtsam.Values
    prior: WholePrior

    @property
    def near(self) -> PathNeighbourhood:
        ones = np.ones(len(self.drive.readings))
        noise = NoiseInformation(NOISE, self.drive.progress_at_readings, ones)
        return PathNeighbourhood(self.drive, self.poses, self.values, self.prior.field, noise)


@pytest.fixture(
    scope="module",
    params=[
        ("vehicle", False),
        ("fixed", False),
        pytest.param(("vehicle", True), marks=pytest.mark.study),  # 1,150 evaluations
    ],
)
def step(request: pytest.FixtureRequest) -> Step:
    axes, loose = request.param
    rng, at = np.random.default_rng(4), np.linspace(0, 1, COUNT)[:, None]
    p, R = at * [0.8, 0.1, 0.02], Rotation.from_rotvec(at * [0.1, 0.05, 0.6]).as_matrix()
    stamps = np.round(3e8 * np.arange(COUNT)).astype(np.int64)
    field = R.transpose(0, 2, 1) @ [20.0, 5.0, -40.0] + np.cumsum(rng.normal(size=(COUNT, 3)), 0)
    series = FieldSeries("mag", "/mag", "lidar", stamps, field)
    trajectory = Trajectory(stamps, R, p, "map", "lidar")
    drift = {"position_share": 0.05, "rotation_deg_per_m": 1.0, "axes": axes}
    options = SlamOptions.model_validate(
        {"key_poses": {"distance_m": 5.0, "angle_deg": 170, "readings": COUNT}, "drift": drift}
    )
    recording = Recording(trajectory, (series,), SourceFile("step", ""))
    drive, _ = prepared(recording, as_recorded(1.0), options)
    drive = replace(
        drive,
        start=replace(drive.start, covariance=EXACT_START),
        sensors=drive.sensors.loosened(0.1, 2.0) if loose else drive.sensors,
    )
    poses = drive.dead_reckoning()
    poses[1] = poses[1].retract(rng.normal(0, 0.02, 6))
    prior = PotentialHyperparameters(sigma=3.0, length=0.6)
    spectrum = FieldSpectrum(
        prior, NOISE, np.append(np.eye(3).ravel(), np.zeros(3)), 0.0, np.zeros(5)
    )
    return Step(
        drive,
        poses,
        drive_values(drive, poses),
        WholePrior(spectrum, np.full(3, -1.0), np.full(3, 1.8), 120),
    )


@dataclass(frozen=True)
class DenseInformation:
    """Covariances of both poses and the sensor, (27, 27), and of the path's errors."""

    covariance: FloatArray
    of_path: FloatArray


def dense(step: Step) -> DenseInformation:
    """Return the covariances by second differences of the cost."""
    drive, sensors = step.drive, step.drive.sensors
    order = gtsam.Ordering()
    for key in (X(0), X(1), V()):
        order.push_back(key)
    J, _ = odometry_graph(drive).linearize(step.values).jacobian(order)
    back, C = np.linalg.inv(J), np.linalg.cholesky(sensors.covariance[0])
    noise = NoiseInformation(NOISE, drive.progress_at_readings, np.ones(len(drive.readings)))
    at = sensors.vectors()[0]

    def cost(errors: FloatArray) -> float:
        off = back @ errors[: len(J)]
        poses = [pose.retract(off[6 * k : 6 * k + 6]) for k, pose in enumerate(step.poses)]
        readings, _ = path_readings(RelativeMotions.along(drive, poses), poses)
        density = PathDensity(readings, step.prior.field, noise)
        sensor = at + C @ errors[len(J) :]
        return density.slopes(np.zeros((len(readings.z), 6)), sensor[None]).cost

    free = len(J) + (len(C) if np.trace(C) > FREE else 0)  # the others stay as they are
    n = len(J) + len(C)
    unit, B = SIDE * np.eye(n), np.zeros((n, n))
    here, alone = cost(np.zeros(n)), [[cost(by * e) for e in unit[:free]] for by in (1.0, -1.0)]
    for i, j in combinations_with_replacement(range(free), 2):
        one, other = (cost(by * (unit[i] + unit[j])) for by in (1.0, -1.0))
        ends = sum(side[i] + side[j] for side in alone)
        B[i, j] = B[j, i] = (one + other - ends + 2 * here) / (2 * SIDE**2)
    values, vectors = np.linalg.eigh(B)
    known = np.maximum(values, 0.0)
    P = np.eye(n) - (vectors * (known / (1 + known))) @ vectors.T
    by = np.zeros((27, n))
    by[:12, : len(J)], by[12:, len(J) :] = back[:12], C
    return DenseInformation(by @ P @ by.T, P[: len(J), : len(J)])


def test_covariances_are_those_of_dense_second_derivatives(step: Step) -> None:
    found = path_information(step.near)
    by_differences = dense(step)
    expected = by_differences.covariance
    scale = np.sqrt(np.diag(expected))
    own = found.step_covariance(0) / np.outer(scale[:12], scale[:12])
    # Retracted poses bend readings between them, which is of second order in a step's error.
    np.testing.assert_allclose(
        own, expected[:12, :12] / np.outer(scale[:12], scale[:12]), atol=0.03
    )
    blocks = found.pose_covariances()
    np.testing.assert_allclose(blocks[1], found.step_covariance(0)[6:, 6:], rtol=1e-6, atol=1e-12)
    sensor = step.drive.sensors.covariance[0] - found.sensors[0] @ found.sensors[0].T
    np.testing.assert_allclose(np.diag(sensor), np.diag(expected)[12:], rtol=0.05, atol=1e-9)
    narrowed = -0.5 * np.linalg.slogdet(by_differences.of_path)[1]
    # Each of the path's errors is known within 0.03, too, of which few are read at all.
    assert found.narrowed == pytest.approx(narrowed, abs=0.06)
    assert narrowed > 0.2


def test_a_path_is_narrowed_by_the_covariance_of_its_own_errors(step: Step) -> None:
    near = step.near
    taken = 0.1 * np.random.default_rng(5).normal(size=(near.size, 7))
    P = np.eye(near.size) - taken @ taken.T
    of_path = P[: near.size - near.sensors.size, : near.size - near.sensors.size]
    assert near.narrowed(taken) == pytest.approx(-0.5 * np.linalg.slogdet(of_path)[1], rel=1e-9)


def test_a_variance_along_a_direction_is_that_of_the_joint_covariance(step: Step) -> None:
    found = path_information(step.near)
    d = np.random.default_rng(2).normal(size=12)
    along = found.variance_along({X(0): d[:6], X(1): d[6:]})
    assert along == pytest.approx(float(d @ found.step_covariance(0) @ d), rel=1e-6)

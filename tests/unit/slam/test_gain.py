"""Whether a correction of odometry is shown to be one: its evidence and its doubt."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from l2m_factors import X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.marginals import Marginals
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solver import colamd_ordering
from l2m_gtsam.slam.unknown_field.gain import NOISE, gain_of, readings_log_likelihood
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.pose_chain import FAR_APART, chain
from tests.drives.slam import rounds
from tests.drives.uniform import EXACT, PRIOR, UNIFORM
from tests.worlds.exact import random_sensors

START, STEP = [0.01] * 3 + [0.1] * 3, [0.02] * 3 + [0.05] * 3
DRAWS = 40_000


def solved_chain() -> tuple[list[gtsam.Pose3], Marginals, FloatArray]:
    """Return nine poses, their marginals, and the covariance of their positions in the map."""
    graph, values, P = chain(START, STEP)
    marginals = Marginals(graph.linearize(values), colamd_ordering(graph))
    poses = [values.atPose3(X(k)) for k in range(len(P))]
    joint = marginals.joint([X(k) for k in range(len(P))])
    R = np.zeros((3 * len(P), 6 * len(P)))
    for k, pose in enumerate(poses):
        R[3 * k : 3 * k + 3, 6 * k + 3 : 6 * k + 6] = pose.rotation().matrix()
    return poses, marginals, R @ joint @ R.T


def moved(poses: list[gtsam.Pose3], by: FloatArray) -> list[gtsam.Pose3]:
    """Return poses with positions moved by (K, 3)."""
    pairs = zip(poses, by, strict=True)
    return [gtsam.Pose3(pose.rotation(), pose.translation() + own) for pose, own in pairs]


@pytest.mark.parametrize("length", [0.02, 0.1, 0.4])
def test_the_doubt_is_how_often_odometry_is_nearer(length: float) -> None:
    """Of true paths that are drawn as the covariance says."""
    poses, marginals, P = solved_chain()
    rng = np.random.default_rng(5)
    d = length * np.cumsum(rng.normal(size=(len(poses), 3)), axis=0)
    gain = gain_of(poses, moved(poses, d), marginals, 1.0)
    error = rng.multivariate_normal(np.zeros(len(P)), P, size=DRAWS)
    nearer = np.sum((error - d.ravel()) ** 2, axis=1) < np.sum(error**2, axis=1)
    spread = np.sqrt(nearer.mean() * (1 - nearer.mean()) / DRAWS)
    assert gain.doubt == pytest.approx(nearer.mean(), abs=4 * spread + 1e-4)
    assert gain.moved_m == pytest.approx(np.sqrt(np.mean(np.sum(d**2, axis=1))))


def test_a_gain_needs_evidence_and_a_correction_beyond_its_sigmas() -> None:
    poses, marginals, _ = solved_chain()
    far, near = (moved(poses, np.full((len(poses), 3), by)) for by in (2.0, 0.01))
    assert gain_of(poses, far, marginals, 1.0).shown
    assert not gain_of(poses, far, marginals, -1.0).shown
    assert not gain_of(poses, near, marginals, 1.0).shown
    assert not gain_of(poses, poses, marginals, 1.0).shown


@pytest.mark.parametrize(("start", "step"), FAR_APART)
def test_where_cholesky_is_refused_the_variance_is_no_smaller(
    start: list[float], step: list[float]
) -> None:
    graph, values, P = chain(start, step)
    marginals = Marginals(graph.linearize(values), colamd_ordering(graph))
    along = {X(k): np.append(np.zeros(3), np.ones(3)) for k in (3, 8)}
    joint = marginals.joint(list(along))
    d = np.concatenate(list(along.values()))
    assert len(P) == 9
    assert marginals.variance_along(along) >= (1 - 1e-6) * (d @ joint @ d)


@pytest.fixture(scope="module")
def drawn() -> DrawnDrive:
    rng = np.random.default_rng(3)
    return drawn_drive(UNIFORM, random_sensors(3, 2), rounds(6), rng, EXACT, 0.2, every=8)


def test_the_likelihood_of_readings_is_that_of_their_normal_distribution(drawn: DrawnDrive) -> None:
    """Over all factors of the noise, tile by tile, without the readings that do not count."""
    drive, sensors = drawn.drive, drawn.drive.sensors
    poses = drawn.poses
    tiled = TiledDrive.lasting(RelativeMotions.along(drive, poses), poses, sensors, PRIOR)
    used = np.arange(len(drive.readings)) % 5 != 0
    total = np.zeros(len(NOISE))
    for tile in tiled.tiles:
        rows = np.flatnonzero(used[tile.rows])
        x, b = tile.placed.x[rows], tile.placed.field(sensors)[rows].ravel()
        own = sensors.noise[tile.placed.readings.sensor[rows], None] ** 2
        F = tile.field.features(x).reshape(len(b), -1)
        white = (own + tile.field.unresolved(x)).ravel()
        total += [
            multivariate_normal(np.zeros(len(b)), F @ F.T + np.diag(f**2 * white)).logpdf(b)
            + 0.5 * len(b) * np.log(2 * np.pi)
            for f in NOISE
        ]
    found = readings_log_likelihood(tiled, sensors, used)
    assert found == pytest.approx(total.max(), abs=1e-3)
    twice = replace(sensors, noise=2 * sensors.noise)
    # The factors cover what a calibration states wrongly; they lie 12 % apart.
    assert readings_log_likelihood(tiled, twice, used) == pytest.approx(found, abs=1.0)

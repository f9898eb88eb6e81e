"""Where a filter goes on from a drive that was solved as a whole."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_factors import M, X
from l2m_gtsam.data import FieldSeries, Recording, SourceFile, Trajectory
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.progress import completed
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import EXACT_START
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.unknown_field import smoothed_drive as module
from l2m_gtsam.slam.unknown_field.path_information import PathNeighbourhood, path_information
from l2m_gtsam.slam.unknown_field.sensor_noise import NoiseInformation
from l2m_gtsam.slam.unknown_field.smoothed_drive import (
    ON_LINE,
    SmoothedDrive,
    end_state,
    smoothed,
    with_noise,
)
from l2m_gtsam.studies.slam.methods import as_recorded

COUNT, EVERY_S = 40, 0.5


@pytest.fixture(scope="module")
def smooth() -> SmoothedDrive:
    """Two laps of 3 m, ten key poses."""
    rng, at = np.random.default_rng(1), np.linspace(0, 4 * np.pi, COUNT)
    p = np.column_stack([0.5 * np.cos(at), 0.4 * np.sin(at), 0.05 * np.sin(2 * at)])
    R = Rotation.from_euler("z", at[:, None] + np.pi / 2).as_matrix()
    prior = PotentialHyperparameters(sigma=6.0, length=0.5)
    basis = PotentialBasis.over(p.min(axis=0) - 1, p.max(axis=0) + 1, prior, 150)
    b = basis.features(p) @ (np.sqrt(basis.variance) * rng.normal(size=len(basis)))
    field = np.einsum("nji,nj->ni", R, b) + 0.3 * rng.normal(size=b.shape)
    stamps = np.round(1e9 * EVERY_S * np.arange(COUNT)).astype(np.int64)
    recording = Recording(
        Trajectory(stamps, R, p, "map", "lidar"),
        (FieldSeries("mag", "/mag", "lidar", stamps, field),),
        SourceFile("laps", ""),
    )
    options = SlamOptions.model_validate(
        {"key_poses": {"distance_m": 0.6, "angle_deg": 170, "readings": 8}}
    )
    drive, _ = prepared(recording, as_recorded(0.3), options)
    drive = replace(drive, start=replace(drive.start, covariance=EXACT_START))
    found = completed(smoothed(drive, drive.dead_reckoning(), options, ON_LINE))
    assert found is not None
    return found


def test_pose_and_sensor_have_the_covariance_of_the_path(
    smooth: SmoothedDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With as many vectors as errors: the same as of poses that are asked for alone."""
    monkeypatch.setattr(module, "VECTORS", 1000)
    state, last = end_state(smooth), smooth.stage.last
    poses, K = last.poses, len(last.poses)
    drive = replace(smooth.drive, sensors=with_noise(last.sensors, smooth.noise))
    weights = np.maximum(last.weights, REJECTED_WEIGHT)
    noise = NoiseInformation(smooth.noise, drive.progress_at_readings, weights)
    path = path_information(PathNeighbourhood(drive, poses, last.values, smooth.prior.field, noise))
    ends = path.learnt[[0, -1]].reshape(12, -1)
    joint = path.odometry.joint([X(0), X(K - 1)]) - ends @ ends.T
    relative = poses[0].between(poses[-1])
    by_ends = np.hstack([-relative.inverse().AdjointMap(), np.eye(6)])
    np.testing.assert_allclose(state.pose.matrix(), relative.matrix(), atol=1e-12)
    expected = by_ends @ joint @ by_ends.T
    scale = np.sqrt(np.diag(expected))
    # Both find all of the 77 eigenvalues; products are finite differences.
    np.testing.assert_allclose(
        state.pose_covariance / np.outer(scale, scale),
        expected / np.outer(scale, scale),
        atol=1e-6,
    )
    own = slice(-12 - DRIFT, -DRIFT)
    distortion = (smooth.drive.sensors.covariance[0] - path.sensors[0] @ path.sensors[0].T)[3:, 3:]
    np.testing.assert_allclose(
        np.diag(state.covariance)[own], np.diag(distortion), rtol=1e-6, atol=1e-12
    )


def test_it_is_a_covariance_that_says_more_than_the_priors(smooth: SmoothedDrive) -> None:
    state, m = end_state(smooth), len(smooth.prior.field)
    P = state.covariance
    assert P.shape == (6 + m + 12 + DRIFT, 6 + m + 12 + DRIFT)
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-9 * np.abs(P).max())
    assert np.linalg.eigvalsh(P).min() > -1e-9 * np.linalg.eigvalsh(P).max()
    weights = P[6 : 6 + m, 6 : 6 + m]
    # A weight's prior has unit variance, and what is known of it is added up to first order.
    assert np.diag(weights).max() < 1.1
    last = smooth.stage.last
    drive = replace(smooth.drive, sensors=with_noise(last.sensors, smooth.noise))
    robust = np.maximum(last.weights, REJECTED_WEIGHT)
    noise = NoiseInformation(smooth.noise, drive.progress_at_readings, robust)
    near = PathNeighbourhood(drive, last.poses, last.values, smooth.prior.field, noise)
    on_path = near.density.weights(last.values.atVector(M(0)), near.sensors[0]).covariance
    # Not to know the path leaves no weight better known.
    assert np.linalg.eigvalsh(weights - on_path).min() > -1e-9
    assert np.trace(on_path) < np.trace(weights) < m

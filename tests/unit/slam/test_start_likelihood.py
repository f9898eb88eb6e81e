"""The likelihood of a window of a drive, against what it is made of written out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.start.likelihood import StartPrior, WindowFit, steps_root
from l2m_gtsam.slam.start.window import DriveWindow, window_of
from tests.drives.slam import SlamDrive, calibrated, slam_drive
from tests.worlds.exact import random_sensors
from tests.worlds.surveyed import SurveyedWorld, strange_hall, surveyed, wandering


def known_of(window: DriveWindow, spread: float = 8.0) -> StartPrior:
    return StartPrior(window.R_odom_lidar[2], 0.03, 0.5, 1.0, spread, 21.1)


@pytest.fixture(scope="module")
def hall() -> SurveyedWorld:
    return surveyed(strange_hall(2))


@pytest.fixture(scope="module")
def driven(hall: SurveyedWorld) -> tuple[SlamDrive, Drive]:
    rng, sensors = np.random.default_rng(2), random_sensors(2, 2)
    drive = slam_drive(hall.world, sensors, wandering(rng, 10), rng)
    return drive, prepared(drive.recording, calibrated(sensors), SlamOptions())[0]


def truth_of(drive: SlamDrive) -> RigidTransform:
    return RigidTransform(drive.truth.R[0], drive.truth.p[0])


def off(truth: RigidTransform, found: RigidTransform) -> FloatArray:
    """Return the right perturbation from what was found to the truth, rotation first."""
    turn = Rotation.from_matrix(found.R.T @ truth.R).as_rotvec()
    return np.append(turn, found.R.T @ (truth.t - found.t))


def test_a_fit_ends_within_its_sigmas(hall: SurveyedWorld, driven: tuple[SlamDrive, Drive]) -> None:
    drive, known = driven
    window = window_of(known, 5.0, 60)
    truth = truth_of(drive)
    begun = RigidTransform(
        truth.R @ Rotation.from_rotvec([0.02, -0.01, 0.06]).as_matrix(),
        truth.t + np.array([0.12, -0.1, 0.08]),
    )
    found = WindowFit(window, hall, known_of(window)).at(begun)
    error = off(truth, found.T_map_lidar)
    # Chi squared of six passes 22.5 once in a thousand.
    assert error @ np.linalg.solve(found.covariance, error) < 22.5
    assert np.linalg.norm(error[3:]) < 0.05
    assert found.explained > 0.95
    assert found.inside == 1.0


def test_a_reading_that_is_wrong_is_not_explained(
    hall: SurveyedWorld, driven: tuple[SlamDrive, Drive]
) -> None:
    drive, known = driven
    window = window_of(known, 5.0, 40)
    wrong = window.readings.field.copy()
    wrong[[5, 20]] += 15.0
    fit = WindowFit(window, hall, known_of(window)).at(truth_of(drive))
    window.readings.field[:] = wrong
    doubted = WindowFit(window, hall, known_of(window)).at(truth_of(drive))
    assert doubted.explained == pytest.approx(fit.explained - 2 / len(window), abs=1e-9)
    shift = off(fit.T_map_lidar, doubted.T_map_lidar)
    assert np.linalg.norm(shift[3:]) < 0.02


def test_steps_move_what_comes_after_them(driven: tuple[SlamDrive, Drive]) -> None:
    """An error of a step moves later poses as the root says of a change of the first frame."""
    window = window_of(driven[1], 3.0, 20)
    step, unit = 4, 3
    root = steps_root(window)[step][:, unit]
    error = np.linalg.cholesky(window.covariance[step])[:, unit] * 1e-3
    R, p = window.R, window.p
    turn = R[step + 1] @ Rotation.from_rotvec(error[:3]).as_matrix() @ R[step + 1].T
    moved = p[step + 1] + R[step + 1] @ error[3:] + turn @ (p[-1] - p[step + 1])
    by_frame = Rotation.from_rotvec(1e-3 * root[:3]).as_matrix() @ p[-1] + 1e-3 * root[3:]
    # Second order of a thousandth.
    np.testing.assert_allclose(moved, by_frame, atol=1e-7)


def test_a_frame_carries_its_poses() -> None:
    rng = np.random.default_rng(1)
    R, p = Rotation.random(random_state=1).as_matrix(), rng.normal(size=3)
    d = 1e-6 * rng.normal(size=6)
    moved_R = Rotation.from_rotvec(d[:3]).as_matrix() @ R
    moved_p = Rotation.from_rotvec(d[:3]).as_matrix() @ p + d[3:]
    carried = carried_back(R[None], p[None])[0] @ d
    here, there = RigidTransform(R, p), RigidTransform(moved_R, moved_p)
    np.testing.assert_allclose(off(there, here), carried, atol=1e-11)

"""Whether sigmas without a map are consistent where odometry errs as it says.

Elsewhere odometry slips: an error that its sigmas hold, but do not describe, so that NEES says
little. Here every step errs as the graph has it, with no steady drift.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.progress import silent
from l2m_gtsam.slam.drive import EXACT_START, StartPose
from l2m_gtsam.slam.exploration import solve_field
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.explorer import ExploringOptions
from tests.drives.drawn import DRIFT, DrawnDrive, drawn_drive
from tests.drives.exploring import OnLine
from tests.drives.slam import laps
from tests.support.pose_errors import mean_nees
from tests.worlds.exact import dipole_world, random_sensors

DRIVES, SENSORS, SECONDS = 18, 6, 90  # two and a half laps of 21 m
RATE, EVERY = 5, 2  # poses of 15 cm, every other one a key pose
EXACT = np.full(15, 1e-6)
OPTIONS = SlamOptions(drift=DRIFT)


def path(seed: int) -> DrawnDrive:
    """Return a drive from an exact start."""
    whole = laps(SECONDS)
    rows = np.arange(0, len(whole), RATE)
    poses = whole[rows[: (len(rows) - 1) // EVERY * EVERY + 1]]
    rng, sensors = np.random.default_rng(1000 + seed), random_sensors(seed, SENSORS)
    drawn = drawn_drive(dipole_world(seed), sensors, poses, rng, EXACT, every=EVERY)
    start = StartPose(RigidTransform(drawn.R[0], drawn.p[0]), EXACT_START)
    return replace(drawn, drive=replace(drawn.drive, start=start))


def nees(poses: list[gtsam.Pose3], covariance: FloatArray, truth: list[gtsam.Pose3]) -> float:
    """Return the mean over the poses after the first, whose sigmas are those of an exact start."""
    return mean_nees(poses[1:], covariance[1:], truth[1:])


def assert_consistent(found: list[float]) -> None:
    """Assert that the mean over drives is 6 within three of its standard errors."""
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    print(f"NEES {np.mean(found):.2f} +- {error:.2f}")
    assert abs(np.mean(found) - 6) < 3 * error


@pytest.mark.study
def test_on_line_poses_err_as_much_as_they_say() -> None:
    """NEES is 6 where sigmas are true; a drive is one figure. 5.5 +- 0.4 in the first ten."""
    found = []
    for seed in range(DRIVES):
        drawn = path(seed)
        online = OnLine.over(drawn.drive, drawn.poses, OPTIONS, ExploringOptions())
        covariance = np.stack([each.pose_covariance for each in online.beliefs])
        found.append(nees([each.pose for each in online.beliefs], covariance, drawn.poses))
    assert_consistent(found)


@pytest.mark.study
def test_off_line_poses_err_as_much_as_they_say() -> None:
    """6.6 +- 0.5, sigmas of 7 cm."""
    found = []
    for seed in range(DRIVES):
        drawn = path(seed)
        solution = solve_field(drawn.drive, OPTIONS, silent).solution
        found.append(nees(solution.poses, solution.pose_covariance, drawn.poses))
    assert_consistent(found)

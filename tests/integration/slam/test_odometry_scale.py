"""Odometry whose ways are all too long or too short alike: its scale is found with the poses."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from l2m_gtsam.progress import silent
from l2m_gtsam.slam.disturbances import slips
from l2m_gtsam.slam.options import DriftOptions, SlamOptions
from l2m_gtsam.slam.pose_graph import write_g2o
from l2m_gtsam.slam.record import odometry_covariance
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.slam.solution import DriveSolution
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.slam import rounds
from tests.support.pose_errors import mean_nees, pose_errors
from tests.worlds.exact import dipole_world, random_sensors

SEEDS, SIGMA = tuple(range(8)), 0.02
EXACT, BAND = np.full(15, 1e-6), np.array([0.0005, 0.9995])
# Beside its scale this odometry walks by 5 mm per root metre.
DRIFT = DriftOptions(
    position_share=0.005 / np.sqrt(10), rotation_deg_per_m=0.02, scale=SIGMA, over_m=10.0
)


@dataclass(frozen=True)
class Scaled:
    """A drive of 18 m whose ways are longer by a share than odometry has them."""

    drawn: DrawnDrive
    longer: float


@cache
def scaled(seed: int) -> Scaled:
    rng, truth = np.random.default_rng(seed), rounds(30)[np.arange(0, 600, 3)]
    sensors = random_sensors(seed, 2)
    drawn = drawn_drive(dipole_world(seed), sensors, truth, rng, EXACT, 0.2, 3, DRIFT)
    longer = float(SIGMA * rng.normal())
    drive = drawn.drive
    steps = replace(drive.steps, p=drive.steps.p / (1 + longer))
    readings = replace(drive.readings, p_key_lidar=drive.readings.p_key_lidar / (1 + longer))
    return Scaled(replace(drawn, drive=replace(drive, steps=steps, readings=readings)), longer)


@cache
def localised(seed: int) -> DriveSolution:
    options = SlamOptions(drift=DRIFT)
    return localise_drive(scaled(seed).drawn.drive, dipole_world(seed), options, silent)


def nees(drawn: DrawnDrive, solution: DriveSolution) -> float:
    return mean_nees(solution.poses, solution.pose_covariance, drawn.poses)


def test_the_scale_is_found_as_well_as_it_says() -> None:
    """In an exact map, shares of 2 %: chi-square of eight drives passes its band in 1 of 1,000."""
    found = [(scaled(seed).longer, localised(seed).scale) for seed in SEEDS]
    error = np.array([each.longer - longer for longer, each in found if each])
    sigma = np.array([each.sigma for _, each in found if each])
    assert len(error) == len(SEEDS)
    assert sigma.max() < 0.25 * SIGMA  # over 18 m; 0.17 to 0.39 % were seen
    low, high = chi2.ppf(BAND, len(error))
    assert low < np.sum((error / sigma) ** 2) < high


def test_poses_are_as_sure_as_they_say() -> None:
    """Poses of a drive err together: no more than half as much again in the mean of eight."""
    assert np.mean([nees(scaled(seed).drawn, localised(seed)) for seed in SEEDS]) < 9


def test_a_scale_that_is_no_variable_is_missed() -> None:
    """The same narrow walk without it: poses that are off by more than they say."""
    seed = max(SEEDS, key=lambda each: abs(scaled(each).longer))
    drive = scaled(seed).drawn.drive
    blind = replace(drive, steps=replace(drive.steps, scale=0.0))
    solution = localise_drive(blind, dipole_world(seed), SlamOptions(drift=DRIFT), silent)
    assert solution.scale is None
    assert nees(scaled(seed).drawn, solution) > 2 * nees(scaled(seed).drawn, localised(seed))


def test_odometry_alone_is_as_unsure_as_its_scale_makes_it() -> None:
    """Over drives of one kind: squared errors of the last pose beside what is reported, six each.

    Chi-square of 8 x 6 passes its band in 1 of 1,000.
    """
    squared = []
    for seed in SEEDS:
        drawn = scaled(seed).drawn
        error = pose_errors(drawn.drive.dead_reckoning(), drawn.poses)[-1]
        squared.append(error @ np.linalg.solve(odometry_covariance(drawn.drive)[-1], error))
    low, high = chi2.ppf(BAND, 6 * len(squared))
    assert low < np.sum(squared) < high


def test_for_who_does_not_ask_the_scale_is_a_walk() -> None:
    """It comes to the same after the way that was said, and adds nothing across steps."""
    steps = scaled(0).drawn.drive.steps
    way = float(np.linalg.norm(steps.p, axis=1).sum())
    walked = steps.with_scale_as_drift(way)
    assert walked.scale == 0
    more = (walked.covariance - steps.covariance)[:, 3:, 3:]
    assert np.trace(more, axis1=1, axis2=2).sum() == pytest.approx((SIGMA * way) ** 2)
    # A right perturbation of the step: its way, in the axes of its end.
    ahead = np.einsum("nji,nj->ni", steps.R, steps.p)
    np.testing.assert_allclose(np.cross(more[:, 0], ahead), 0, atol=1e-12)


def test_a_scale_is_no_slip() -> None:
    """Ways a third longer than odometry has them: each step is a slip, unless that is known."""
    drive = scaled(0).drawn.drive
    poses = [gtsam.Pose3()]
    for k in range(len(drive.steps)):
        poses.append(poses[-1].compose(drive.step(k, scale_error=0.33)))
    assert not list(slips(drive, poses, scale_error=0.33))
    assert list(slips(drive, poses))


def test_edges_are_as_long_as_ways_came_out(tmp_path: Path) -> None:
    solution = localised(1)
    write_g2o(tmp_path / "graph.g2o", solution)
    lines = (tmp_path / "graph.g2o").read_text().splitlines()
    edges = np.array([line.split()[3:6] for line in lines if line.startswith("EDGE")], float)
    # Six digits of some 0.1 m.
    expected = (1 + solution.scale_error) * solution.drive.steps.p
    np.testing.assert_allclose(edges, expected, atol=1e-6)


def test_steps_along_fixed_axes_are_edges_as_well(tmp_path: Path) -> None:
    """GTSAM writes no factors of its own making in Python: it would leave them out in silence."""
    solution = localised(1)
    drive = solution.drive
    along = replace(drive.steps, fixed_axes=np.zeros_like(drive.steps.p))
    write_g2o(tmp_path / "graph.g2o", replace(solution, drive=replace(drive, steps=along)))
    lines = (tmp_path / "graph.g2o").read_text().splitlines()
    assert sum(line.startswith("EDGE") for line in lines) == len(drive.steps)

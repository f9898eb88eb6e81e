"""Odometry that turns too far all along, as by a gyroscope's bias: found with the poses."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from l2m_gtsam.progress import silent
from l2m_gtsam.slam.options import DriftOptions, SlamOptions
from l2m_gtsam.slam.result import turning_hints
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.slam.solution import DriveSolution
from tests.drives.drawn import DrawnDrive, drawn_drive
from tests.drives.slam import rounds
from tests.support.pose_errors import mean_nees
from tests.worlds.exact import dipole_world, random_sensors

TURN_DEG_PER_M = 1.0
SEEDS = (0, 1, 2, 3)
EXACT = np.full(15, 1e-6)
DRIFT = DriftOptions(
    position_share=0.005 / np.sqrt(10),
    rotation_deg_per_m=0.02,
    steady=0.0,
    steady_turn_deg_per_m=TURN_DEG_PER_M,
    over_m=10.0,
)
OPTIONS = SlamOptions(drift=DRIFT)


@cache
def turning(seed: int) -> tuple[DrawnDrive, float]:
    """Return a drive of 18 m whose odometry turns, and by how many degrees per metre."""
    rng, truth = np.random.default_rng(100 + seed), rounds(30)[np.arange(0, 600, 2)]
    drawn = drawn_drive(
        dipole_world(seed), random_sensors(seed, 2), truth, rng, EXACT, 0.2, 3, DRIFT
    )
    turn = TURN_DEG_PER_M * rng.normal()
    steps = drawn.drive.steps
    angle = np.deg2rad(turn) * np.linalg.norm(steps.p, axis=1)
    about = Rotation.from_rotvec(angle[:, None] * drawn.R[:-1, 2]).as_matrix()
    return replace(drawn, drive=replace(drawn.drive, steps=replace(steps, R=about @ steps.R))), turn


@cache
def localised(seed: int) -> DriveSolution:
    return localise_drive(turning(seed)[0].drive, dipole_world(seed), OPTIONS, silent)


def nees(drawn: DrawnDrive, solution: DriveSolution) -> float:
    return mean_nees(solution.poses, solution.pose_covariance, drawn.poses)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_turning_is_found(seed: int) -> None:
    """Within four of the sigmas that are stated of it, which are a tenth of the prior's."""
    found = localised(seed).turn
    assert found is not None
    assert abs(found.left_deg_per_m - turning(seed)[1]) < 4 * found.sigma
    assert found.sigma < 0.1 * TURN_DEG_PER_M


def test_poses_are_as_sure_as_they_say() -> None:
    """Poses of a drive err together: no more than half as much again in the mean."""
    assert np.mean([nees(turning(seed)[0], localised(seed)) for seed in SEEDS]) < 9


def test_a_turning_that_is_no_variable_is_missed() -> None:
    seed = max(SEEDS, key=lambda each: abs(turning(each)[1]))
    drawn = turning(seed)[0]
    blind = replace(drawn.drive, steps=replace(drawn.drive.steps, turning=None))
    solution = localise_drive(blind, dipole_world(seed), OPTIONS, silent)
    assert solution.turn is None
    assert nees(drawn, solution) > 2 * nees(drawn, localised(seed))
    # Steps that may not turn so much hold the poses back.
    assert 0.05 < hinted(solution) / turning(seed)[1] < 1.0
    assert turning_hints(localised(seed)) == ()


def hinted(solution: DriveSolution) -> float:
    """Return by how much odometry is said to turn too far to the left, deg per metre."""
    (told,) = turning_hints(solution)
    found = re.search(r"turn by ([0-9.]+) deg per metre or more too far to the (left|right)", told)
    assert found is not None
    return float(found[1]) * (1 if found[2] == "left" else -1)


def test_steps_that_may_turn_tell_by_how_much_they_do() -> None:
    """To a fifth: stated as errors of 0.3 degrees per metre over 10 m, it is nearly followed."""
    seed = max(SEEDS, key=lambda each: abs(turning(each)[1]))
    drive = turning(seed)[0].drive
    covariance = drive.steps.covariance.copy()
    length = np.linalg.norm(drive.steps.p, axis=1)[:, None, None]
    covariance[:, :3, :3] += np.deg2rad(0.3) ** 2 * 10 * length * np.eye(3)
    loose = replace(drive, steps=replace(drive.steps, turning=None, covariance=covariance))
    solution = localise_drive(loose, dipole_world(seed), OPTIONS, silent)
    assert hinted(solution) == pytest.approx(turning(seed)[1], rel=0.2)


def test_of_errors_of_steps_alone_nothing_is_told() -> None:
    """Of five drives one in 70 would be, by chance."""
    for seed in range(5):
        rng, truth = np.random.default_rng(200 + seed), rounds(15)[np.arange(0, 300, 2)]
        walk = DRIFT.model_copy(update={"steady_turn_deg_per_m": 0.0})
        world = dipole_world(seed)
        drawn = drawn_drive(world, random_sensors(seed, 2), truth, rng, EXACT, 0.2, 3, walk)
        solution = localise_drive(drawn.drive, world, SlamOptions(drift=walk), silent)
        assert turning_hints(solution) == ()


def test_steps_without_the_turning_are_those_of_the_poses() -> None:
    seed = max(SEEDS, key=lambda each: abs(turning(each)[1]))
    drawn, solution = turning(seed)[0], localised(seed)
    still = drawn.drive.without_drift(solution.steady, solution.poses)
    assert still.steps.turning is None
    assert drawn.reckoned_off(still) < drawn.reckoned_off(drawn.drive) / 3


def test_for_who_does_not_ask_the_turning_is_a_walk_of_the_heading() -> None:
    steps = turning(0)[0].drive.steps
    path = float(steps.path[-1])
    more = steps.as_walk(path).covariance - steps.covariance
    about_up = np.einsum("ni,nij,nj->n", steps.up, more[:, :3, :3], steps.up)
    # In all the variance of the whole turning, about the third axis alone.
    assert about_up.sum() == pytest.approx(np.deg2rad(TURN_DEG_PER_M * path) ** 2, rel=1e-9)
    np.testing.assert_allclose(np.trace(more, axis1=1, axis2=2), about_up, rtol=1e-9)


def test_a_scale_and_a_turning_exclude_each_other() -> None:
    with pytest.raises(ValidationError, match="one is estimated, give one"):
        DriftOptions(scale=0.01, steady_turn_deg_per_m=0.1)

"""Passes of a real wheeled robot: in the map of the others, and without one."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.localisation import localise
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.slam_array.odometry import slipping, walked
from l2m_gtsam.studies.slam_array.robot import RUNS, other_passes, robot_pass
from tests.support.pose_errors import pose_nees, position_error

OPTIONS = SlamOptions.model_validate(
    {"key_poses": {"distance_m": 0.1, "readings": 1}, "calibration": "refined"}
)
LOWEST, HIGHEST = 3.0, 12.0  # of NEES; 6 where sigmas are right
IN_MAP, WITHOUT = 0.85, 0.7  # share of odometry's error that is to be removed
Drifted = Callable[[Trajectory, np.random.Generator], Trajectory]


def missed(reason: str) -> pytest.MarkDecorator:
    return pytest.mark.xfail(reason=reason, strict=True)


@pytest.mark.study
@pytest.mark.parametrize(
    ("run", "drift"),
    [
        (1, slipping),
        pytest.param(2, slipping, marks=missed("79 % removed, NEES 12.4")),
        (3, slipping),
        (4, slipping),
        (1, walked),
        pytest.param(2, walked, marks=missed("83 % removed, NEES 12.2")),
        pytest.param(3, walked, marks=missed("75 % of 116 mm removed")),
        pytest.param(4, walked, marks=missed("80 % of 98 mm removed")),
    ],
)
def test_in_the_map_of_the_others(shared_data: Path, run: int, drift: Drifted) -> None:
    """Odometry that slips by 1 %, and one that drifts as default options say."""
    passes = other_passes(shared_data, run)
    own = robot_pass(shared_data, run)
    truth = own.trajectory[np.arange(0, len(own.trajectory), 5)]
    drive = replace(own, trajectory=drift(truth, np.random.default_rng(run)))
    result = localise(drive, passes.field_map, passes.suite, OPTIONS, silent).result
    before, after = (position_error(truth, each) for each in (result.odometry, result.trajectory))
    nees = pose_nees(truth, result.trajectory)[1:].mean()
    print(f"{run}: {1e3 * before:.0f} -> {1e3 * after:.0f} mm, NEES {nees:.1f}")
    assert not any("jumps" in note for note in result.notes)
    assert after <= (1 - IN_MAP) * before
    assert LOWEST <= nees <= HIGHEST


@dataclass(frozen=True)
class WithoutMap:
    """A pass that was solved without a map, by the others' calibration, and its true poses."""

    truth: Trajectory
    result: LocalisationResult


@pytest.fixture(
    scope="module", params=[(run, drift) for drift in (slipping, walked) for run in RUNS]
)
def without_map(request: pytest.FixtureRequest, shared_data: Path) -> WithoutMap:
    run, drift = request.param
    suite, own = other_passes(shared_data, run).suite, robot_pass(shared_data, run)
    truth = own.trajectory[np.arange(0, len(own.trajectory), 5)]
    drive = replace(own, trajectory=drift(truth, np.random.default_rng(run)))
    return WithoutMap(truth, explore(drive, suite, OPTIONS, silent).result)


@pytest.mark.study
@missed("no gain shown, or 2 to 70 % removed; pivots of passes 1 and 4 are taken for slips")
def test_without_a_map(without_map: WithoutMap) -> None:
    """The same with the others' calibration alone."""
    truth, result = without_map.truth, without_map.result
    before, after = (position_error(truth, each) for each in (result.odometry, result.trajectory))
    nees = pose_nees(truth, result.trajectory)[1:].mean()
    print(f"{1e3 * before:.0f} -> {1e3 * after:.0f} mm, NEES {nees:.1f}, {result.gain}")
    assert not any("jumps" in note for note in result.notes)
    assert after <= (1 - WITHOUT) * before
    assert LOWEST <= nees <= HIGHEST


@pytest.mark.study
def test_it_is_never_worse_than_odometry_without_saying_so(without_map: WithoutMap) -> None:
    """Either poses are nearer to the truth, or they are odometry's, and the result says why."""
    truth, result = without_map.truth, without_map.result
    before, after = (position_error(truth, each) for each in (result.odometry, result.trajectory))
    assert result.gain is not None
    if result.gain.shown:
        assert after < before
    else:
        np.testing.assert_allclose(result.trajectory.p, result.odometry.p, atol=1e-9)
        assert any(result.gain.reason in note for note in result.notes)

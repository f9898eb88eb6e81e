"""Where a drive comes back to, from odometry that is off by more than the field's reach."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import EXACT_START, Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.return_search import (
    MOST_NODES,
    SIGMAS,
    ReturnSearch,
    evidence,
    nodes,
)
from l2m_gtsam.slam.unknown_field.tiles import drive_prior
from l2m_gtsam.studies.slam_array.odometry import slipping
from tests.drives.slam import calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

COARSE = 16.0  # factor of the noise
ONE_LAP = laps(26, (1.9, 1.4))  # 15 m, the last five where the first were


@dataclass(frozen=True)
class Lap:
    """A drive whose odometry is off by the end, and where it truly was."""

    drive: Drive
    search: ReturnSearch
    truth: list[gtsam.Pose3]

    def last_off(self, poses: list[gtsam.Pose3]) -> float:
        return float(np.linalg.norm(poses[-1].translation() - self.truth[-1].translation()))


def lap(seed: int, share: float) -> Lap:
    """Return a lap with odometry that is wrong by a share of the way, as far as is stated."""
    options = SlamOptions.model_validate(
        {
            "key_poses": {"distance_m": 0.3, "readings": 2},
            "tiles": {"modes": 100, "learn_over_m": 9.0},
            "drift": {"position_share": 1.3 * share, "over_m": 10.0},
        }
    )
    own, rng = random_sensors(seed, 4), np.random.default_rng(seed)
    recorded = slam_drive(dipole_world(seed), own, ONE_LAP, rng)
    odometry = slipping(ONE_LAP, rng, share=share)
    recording = replace(recorded.recording, trajectory=odometry)
    drive, _ = prepared(recording, calibrated(own), options)
    drive = replace(drive, start=replace(drive.start, covariance=EXACT_START))
    rows = np.searchsorted(ONE_LAP.stamp_ns, drive.stamp_ns)
    truth = [gtsam.Pose3(gtsam.Rot3(ONE_LAP.R[row]), ONE_LAP.p[row]) for row in rows]
    prior = drive_prior(drive, drive.dead_reckoning(), options.tiles)
    search = ReturnSearch(drive, prior, COARSE * drive.sensors.noise, known=0, begun=0)
    return Lap(drive, search, truth)


@pytest.mark.parametrize("seed", [3, 5, 8])
def test_from_two_metres_off_a_drive_is_brought_back_to_where_a_solver_finds_it(seed: int) -> None:
    """To a step of the lattice, 0.4 to 0.7 m here; and the path bends, it does not break."""
    made = lap(seed, share=0.15)
    poses = made.drive.dead_reckoning()
    found = made.search.likeliest(poses)
    assert made.last_off(poses) > 2.0
    assert made.last_off(found) < 0.7
    assert made.search.agreement(found) > made.search.agreement(poses) + 20
    steps = [
        a.between(b).localCoordinates(c.between(d))
        for a, b, c, d in zip(poses, poses[1:], found, found[1:], strict=False)
    ]
    assert np.abs(steps).max() < 0.1  # of 0.3 m; the whole is moved by 2 m


def test_poses_that_are_right_are_left_as_they_are() -> None:
    made = lap(3, share=0.15)
    assert made.search.likeliest(made.truth) is made.truth


def test_odometry_within_the_field_s_reach_is_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it may be 0.1 m off the lattice has its middle alone, and nothing else is asked."""
    made, asked = lap(3, share=0.005), list[int]()
    whole = ReturnSearch.agreement

    def counted(self: ReturnSearch, poses: list[gtsam.Pose3]) -> float:
        asked.append(1)
        return whole(self, poses)

    monkeypatch.setattr(ReturnSearch, "agreement", counted)
    poses = made.drive.dead_reckoning()
    assert made.search.likeliest(poses) is poses
    assert len(asked) == 1


def test_known_poses_stay() -> None:
    made = lap(8, share=0.15)
    poses, half = made.drive.dead_reckoning(), 20
    found = replace(made.search, known=half).likeliest(poses)
    moved = [
        np.linalg.norm(a.translation() - b.translation()) for a, b in zip(poses, found, strict=True)
    ]
    assert max(moved[: half + 1]) < 0.01
    assert moved[-1] > 0.3


@given(
    st.tuples(st.floats(1e-3, 20.0), st.floats(1e-3, 20.0), st.floats(0, np.pi)),
    st.floats(0.2, 2.0),
)
def test_nodes_are_those_of_a_lattice_within_three_sigmas(
    gaussian: tuple[float, float, float], step: float
) -> None:
    long, short, angle = gaussian
    axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = axes @ np.diag([long**2, short**2]) @ axes.T
    found = nodes(covariance, step)
    assert len(found) <= MOST_NODES
    if SIGMAS * max(long, short) < step:
        assert not len(found)
        return
    squared = np.einsum("ni,ni->n", found, np.linalg.solve(covariance, found.T).T)
    assert squared.max(initial=0.0) <= SIGMAS**2 + 1e-6
    assert np.all(np.diff(squared) >= -1e-6)
    apart = np.linalg.norm(found[:, None] - found, axis=2)
    assert apart[np.triu_indices(len(found), 1)].min(initial=step) >= step * (1 - 1e-9)


def test_the_evidence_is_that_of_the_normal_distribution() -> None:
    """Of readings ``y = F w + v`` with unit weights and noise: differences of its logarithm."""
    rng = np.random.default_rng(0)
    features, values = rng.normal(size=(7, 3, 4)), rng.normal(size=(2, 7, 3))
    F = features.reshape(21, 4)
    normal = multivariate_normal(np.zeros(21), np.eye(21) + F @ F.T)

    def expected(y: FloatArray) -> float:
        white = multivariate_normal(np.zeros(21), np.eye(21))
        return float(normal.logpdf(y.ravel()) - white.logpdf(y.ravel()))

    for y in values:
        assert evidence(features, y) == pytest.approx(expected(y), abs=1e-9)

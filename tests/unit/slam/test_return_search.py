"""Where a drive comes back to, from odometry that is off by more than the field's reach."""

from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import EXACT_START, Drive, as_poses
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.changed_visits import Remembered
from l2m_gtsam.slam.unknown_field.return_search import (
    AT_NODE_M,
    CLEAR,
    DEPTH_M,
    MOST_NODES,
    SIGMAS,
    STEPS,
    Bending,
    ReturnSearch,
    nodes,
)
from l2m_gtsam.slam.unknown_field.tiled_stages import FOLLOWED
from l2m_gtsam.slam.unknown_field.tiles import drive_prior
from l2m_gtsam.studies.slam_array.odometry import slipping
from tests.drives.slam import calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

ONE_LAP = laps(26, (1.9, 1.4))  # 15 m, the last five where the first were


@dataclass(frozen=True)
class Lap:
    """A drive whose odometry is off by the end, and where it truly was."""

    drive: Drive
    search: ReturnSearch
    truth: list[gtsam.Pose3]

    def agreement(self, poses: list[gtsam.Pose3]) -> float:
        readings = RelativeMotions.along(self.drive, poses).readings
        return self.search.agreement(readings, poses)

    def last_off(self, poses: list[gtsam.Pose3]) -> float:
        return float(np.linalg.norm(poses[-1].translation() - self.truth[-1].translation()))


@cache
def lap(seed: int, share: float) -> Lap:
    """Return a lap with odometry that is wrong by a share of the way, as far as is stated."""
    options = SlamOptions.model_validate(
        {
            "key_poses": {"distance_m": 0.3, "readings": 2},
            "tiles": {"modes": 60, "learn_over_m": 9.0},
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
    truth = as_poses(ONE_LAP.R[rows], ONE_LAP.p[rows])
    prior = drive_prior(drive, drive.dead_reckoning(), options.tiles)
    search = ReturnSearch(drive, prior, FOLLOWED[0] * drive.sensors.noise, known=0, begun=0)
    return Lap(drive, search, truth)


@pytest.mark.parametrize("seed", [3, 5])
def test_from_two_metres_off_a_drive_is_brought_within_the_field_s_reach(seed: int) -> None:
    """Within a metre, the greatest depth that counts; and the path bends, it does not break."""
    made = lap(seed, share=0.15)
    poses = made.drive.dead_reckoning()
    found = made.search.likeliest(poses)
    assert made.last_off(poses) > 2.0
    assert made.last_off(found) < DEPTH_M[1]
    assert made.agreement(found) > made.agreement(poses) + CLEAR
    steps = [
        a.between(b).localCoordinates(c.between(d))
        for a, b, c, d in zip(poses, poses[1:], found, found[1:], strict=False)
    ]
    assert np.abs(steps).max() < 0.1  # of 0.3 m; the whole is moved by 2 m


def test_poses_that_are_right_are_left_as_they_are() -> None:
    made = lap(3, share=0.15)
    assert made.search.likeliest(made.truth) is made.truth


def test_odometry_within_the_field_s_reach_is_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it may be some centimetres off nothing is asked."""
    made, asked = lap(3, share=0.005), list[int]()
    whole = ReturnSearch.agreement

    def counted(self: ReturnSearch, readings: KeyPoseReadings, poses: list[gtsam.Pose3]) -> float:
        asked.append(1)
        return whole(self, readings, poses)

    monkeypatch.setattr(ReturnSearch, "agreement", counted)
    poses = made.drive.dead_reckoning()
    assert made.search.likeliest(poses) is poses
    assert not asked


def test_a_path_bends_to_a_node_at_the_cost_that_its_end_s_covariance_says() -> None:
    """The cost of a Gaussian's end x is x^T P^-1 x / 2, in the linear system of odometry."""
    made = lap(3, share=0.15)
    poses = made.drive.dead_reckoning()
    bending = Bending(made.drive, poses, 0)
    for node in np.random.default_rng(0).normal(size=(5, 3)):
        bent, cost = bending.to(node)
        expected = 0.5 * node @ np.linalg.solve(bending.covariance, node)
        # A millimetre of freedom at the node, over sigmas of a decimetre and more.
        assert cost == pytest.approx(expected, rel=1e-3)
        np.testing.assert_allclose(
            bent[-1].translation() - poses[-1].translation(), node, atol=2 * AT_NODE_M
        )


def test_known_poses_stay() -> None:
    made = lap(8, share=0.15)
    poses, half = made.drive.dead_reckoning(), 20
    found = replace(made.search, known=half).likeliest(poses)
    moved = [
        np.linalg.norm(a.translation() - b.translation()) for a, b in zip(poses, found, strict=True)
    ]
    assert max(moved[: half + 1]) < 0.01
    assert moved[-1] > DEPTH_M[0] * STEPS[0] / 2  # half of the finest step


@given(
    st.tuples(*3 * [st.floats(1e-3, 20.0)]),
    st.integers(0, 2**32 - 1),
    st.floats(0.4, 1.0),
)
def test_nodes_are_those_of_a_lattice_within_some_sigmas(
    sigmas: tuple[float, float, float], turned: int, depth: float
) -> None:
    axes = Rotation.random(rng=np.random.default_rng(turned)).as_matrix()
    covariance = axes @ np.diag(np.square(sigmas)) @ axes.T
    found, step = nodes(covariance, depth)
    assert depth / 2 <= step <= depth
    assert len(found) <= MOST_NODES
    assert bool(len(found)) == (SIGMAS * max(sigmas) >= depth)
    if not len(found):
        return
    # A covariance of a millimetre beside one of 20 m is known to 1e-16 of the larger.
    squared = np.einsum("ni,ni->n", found, np.linalg.solve(covariance, found.T).T)
    assert squared.max(initial=0.0) <= SIGMAS**2 * (1 + 1e-4)
    assert np.all(np.diff(squared) >= -1e-4 * SIGMAS**2)
    apart = np.linalg.norm(found[:, None] - found, axis=2)
    assert apart[np.triu_indices(len(found), 1)].min(initial=step) >= step * (1 - 1e-9)


def test_the_evidence_is_that_of_the_normal_distribution() -> None:
    """Of readings ``y = F w + v`` with unit weights and noise: differences of its logarithm."""
    rng = np.random.default_rng(0)
    F, values = rng.normal(size=(21, 4)), rng.normal(size=(2, 21))
    normal = multivariate_normal(np.zeros(21), np.eye(21) + F @ F.T)

    def expected(y: FloatArray) -> float:
        white = multivariate_normal(np.zeros(21), np.eye(21))
        return float(normal.logpdf(y) - white.logpdf(y))

    for y in values:
        seen = Remembered(F.T @ F, F.T @ y)
        assert seen.evidence == pytest.approx(expected(y), abs=1e-9)

"""Loops without errors: which places they link, and what they leave of a drift."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import Trajectory
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.peers.exact_loops import AWAY_M, closed_by_exact_loops, exact_loops
from l2m_gtsam.studies.slam.methods import given_sensors, rms
from l2m_gtsam.studies.slam_array.odometry import walked
from tests.drives.slam import laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

NEAR_M = 0.4


@pytest.fixture(scope="module")
def drive() -> tuple[Drive, Trajectory]:
    """Two laps of 21 m by odometry that walks at random, and the true poses."""
    rng = np.random.default_rng(0)
    sensors = random_sensors(1, 1)
    recorded = slam_drive(dipole_world(1), sensors, laps(70), rng)
    options = SlamOptions.model_validate(
        {"key_poses": {"distance_m": 0.5}, "drift": {"steady": 0.0}}
    )
    walking = replace(recorded.recording, trajectory=walked(recorded.truth, rng))
    found, _ = prepared(walking, given_sensors(sensors, 0.2), options)
    rows = np.searchsorted(recorded.truth.stamp_ns, found.stamp_ns)
    return found, recorded.truth[rows]


def test_links_are_the_true_motions_between_places_that_are_near(
    drive: tuple[Drive, Trajectory],
) -> None:
    driven, truth = drive
    links = exact_loops(driven, truth, NEAR_M)
    assert len(links) > 10
    apart = np.linalg.norm(truth.p[links.key_pose] - truth.p[links.origin], axis=1)
    path = driven.steps.path[links.key_pose] - driven.steps.path[links.origin]
    assert apart.max() <= NEAR_M
    assert path.min() >= AWAY_M
    p = truth.p[links.origin] + np.einsum("lij,lj->li", truth.R[links.origin], links.p)
    np.testing.assert_allclose(p, truth.p[links.key_pose], atol=1e-12)
    R = truth.R[links.origin] @ links.R
    np.testing.assert_allclose(R, truth.R[links.key_pose], atol=1e-12)


def test_a_place_that_is_seen_again_is_where_it_was(drive: tuple[Drive, Trajectory]) -> None:
    """The second lap follows the first; what the first has drifted stays."""
    driven, truth = drive
    poses = closed_by_exact_loops(driven, truth, NEAR_M)
    links = exact_loops(driven, truth, NEAR_M)
    for number in range(len(links)):
        found = poses[links.origin[number]].between(poses[links.key_pose[number]])
        link = gtsam.Pose3(gtsam.Rot3(links.R[number]), links.p[number])
        # Odometry of 20 mm and more pulls on some links of 1 mm each.
        assert np.linalg.norm(gtsam.Pose3.Logmap(link.between(found))) < 0.01
    left, before = (
        rms(np.stack([pose.translation() for pose in each]), truth.p)
        for each in (poses, driven.dead_reckoning())
    )
    # The drift of the first lap is left, many times the millimetre that the links are known to.
    assert 0.01 < left < 0.7 * before


def test_without_a_place_that_is_near_odometry_stays(drive: tuple[Drive, Trajectory]) -> None:
    driven, truth = drive
    poses = closed_by_exact_loops(driven, truth, 1e-3)
    for found, known in zip(poses, driven.dead_reckoning(), strict=True):
        assert found.equals(known, 1e-6)

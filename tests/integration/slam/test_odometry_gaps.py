"""Odometry that is silent for some seconds: its step over them is right, or it is not."""

from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.replay import give
from l2m_gtsam.slam.online.saved import resumed_slam, saved_state
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.storage.online_log import read_state, write_state
from tests.drives.gaps import STILL, with_gap
from tests.drives.lost import QUICK
from tests.drives.online import OPTIONS, WORLD, driven, in_map, online_hall
from tests.drives.slam import COARSE, calibrated, laps, rounds, slam_drive
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.surveyed import strange_hall, surveyed, wandering

ASIDE = RigidTransform(np.eye(3), np.array([0.0, 2.5, 0.0]))


def test_a_gap_of_odometry_is_reported_and_its_sigma_says_so() -> None:
    """Odometry has gone on meanwhile: the pose after it is as far off as its sigma says."""
    hall, rows = online_hall(), (200, 260)
    run, truth = driven(in_map(hall), with_gap(hall[1], rows)), hall[1].truth
    assert EventKind.ODOMETRY_GAP in run.kinds
    at_end = int(np.searchsorted(run.trajectory().stamp_ns, truth.stamp_ns[rows[1]]))
    sigma = np.sqrt(np.trace(run.poses[at_end].covariance[3:, 3:]))
    assert run.off(truth)[at_end] < 4 * sigma
    assert run.nees(truth)[1:].mean() < 12
    assert run.off(truth)[-10:].max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_one_sensor_in_a_map_follows_odometry_that_was_silent_alone(
    seed: int, tmp_path: Path
) -> None:
    """Eight seconds, 4.8 m: by the motion before it readings fit a wrong place, metres away.

    Saved while the step is in doubt, it goes on both ways.
    """
    sensors, rng = random_sensors(seed, 1), np.random.default_rng(seed)
    drive = slam_drive(WORLD, sensors, rounds(30.0), rng)
    given = with_gap(drive, (200, 360))
    run = driven(OnlineSlam(calibrated(sensors), OPTIONS, WORLD), given)
    (told,) = run.texts(EventKind.GAP_DECIDED)
    assert "was right, by the readings" in told
    assert run.off(drive.truth).max() < 0.3
    assert run.nees(drive.truth)[1:].mean() < 12
    end_ns = int(drive.truth.stamp_ns[370])
    at = next(k for k, each in enumerate(given) if each.stamp_ns > end_ns)
    slam = OnlineSlam(calibrated(sensors), OPTIONS, WORLD)
    for message in given[:at]:
        give(slam, message)
    write_state(tmp_path / "state.npz", saved_state(slam))
    state = read_state(tmp_path / "state.npz")
    again = driven(resumed_slam(state, calibrated(sensors), OPTIONS, WORLD), given[at:])
    assert again.texts(EventKind.GAP_DECIDED) == [told]
    assert again.off(drive.truth).max() < 0.3


def test_where_odometry_stood_still_over_a_gap_the_place_is_searched_for() -> None:
    """The vehicle went on by 1.8 m, odometry did not: no pose comes out until its place is found.

    With a prior as wide as what it may have driven a filter found a wrong place, and was sure.
    """
    world, rng = strange_hall(0), np.random.default_rng(0)
    sensors = random_sensors(0, 2)
    drive = slam_drive(world, sensors, wandering(rng, 40.0), rng)
    options = SlamOptions.model_validate({"key_poses": COARSE, "start": {"search": QUICK}})
    slam = OnlineSlam(calibrated(sensors), options, surveyed(world))
    run, truth = driven(slam, with_gap(drive, (200, 260), STILL)), drive.truth
    gap = run.kinds.index(EventKind.ODOMETRY_GAP)
    assert run.kinds[gap + 1 :][0] is EventKind.START_OPEN
    assert run.kinds[-1] is EventKind.START_FOUND
    assert run.nees(truth)[1:].mean() < 12
    assert run.off(truth)[-10:].max() < 0.1
    assert run.trajectory().stamp_ns[-1] == truth.stamp_ns[-1]


@pytest.mark.parametrize("seed", range(3))
def test_where_the_step_over_a_gap_is_wrong_the_place_is_searched_for(seed: int) -> None:
    """Odometry says 2.5 m aside, as after a new start.

    Until that shows, sigmas leave it open: the mixture of both has a wider tail than a Gaussian.
    """
    world, rng = strange_hall(seed), np.random.default_rng(seed)
    sensors = random_sensors(seed, 2)
    drive = slam_drive(world, sensors, wandering(rng, 40.0), rng)
    options = SlamOptions.model_validate({"key_poses": COARSE, "start": {"search": QUICK}})
    slam = OnlineSlam(calibrated(sensors), options, surveyed(world))
    run, truth = driven(slam, with_gap(drive, (200, 280), ASIDE)), drive.truth
    assert run.kinds.index(EventKind.START_OPEN) < run.kinds.index(EventKind.START_FOUND)
    assert run.off(truth)[-10:].max() < 0.1
    sigma = np.sqrt([np.trace(each.covariance[3:, 3:]) for each in run.poses])
    wrong = run.off(truth) > 1.0
    assert (run.off(truth)[wrong] < 5 * sigma[wrong]).all()


@pytest.mark.parametrize("seed", range(2))
def test_without_a_map_odometry_that_was_silent_alone_is_believed(seed: int) -> None:
    """In the third lap of 10 m, for 5 s: what is remembered of the first two decides."""
    sensors, rng = random_sensors(seed, 2), np.random.default_rng(seed)
    options = SlamOptions.model_validate(
        {
            "key_poses": {"distance_m": 0.3, "readings": 2},
            "tiles": {"modes": 60, "learn_over_m": 6.0},
        }
    )
    drive = slam_drive(dipole_world(seed), sensors, laps(50, (1.9, 1.4)), rng)
    run = driven(OnlineSlam(calibrated(sensors), options), with_gap(drive, (500, 600)))
    (told,) = run.texts(EventKind.GAP_DECIDED)
    assert "was right, by the readings" in told
    assert run.off(drive.truth).max() < 0.3
    assert run.nees(drive.truth)[1:].mean() < 12


def test_without_a_map_a_wrong_step_that_nothing_decides_is_left_open() -> None:
    """Odometry says 2.5 m aside, where the vehicle has not been and no memory speaks against it.

    With the stated error alone NEES is 2,000: as a Gaussian of 5 % for a wrong step has it, 40.
    """
    sensors, rng = random_sensors(0, 2), np.random.default_rng(0)
    options = SlamOptions.model_validate(
        {
            "key_poses": {"distance_m": 0.3, "readings": 2},
            "tiles": {"modes": 60, "learn_over_m": 6.0},
        }
    )
    drive = slam_drive(dipole_world(0), sensors, laps(60, (1.9, 1.4)), rng)
    run = driven(OnlineSlam(calibrated(sensors), options), with_gap(drive, (500, 580), ASIDE))
    assert EventKind.GAP_DECIDED not in run.kinds
    assert run.nees(drive.truth)[1:].mean() < 100

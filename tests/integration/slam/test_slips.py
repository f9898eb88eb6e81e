"""Jumps of odometry are slips or motion, as the magnetometers have it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.data import Recording
from l2m_gtsam.progress import silent
from l2m_gtsam.recording.odometry_jumps import JumpOptions, without_jumps
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localisation import localise, prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.slips import judged
from l2m_gtsam.slam.smoother import localise_drive
from l2m_gtsam.studies.slam_array.odometry import slipping
from l2m_gtsam.studies.slam_array.robot import other_passes, robot_pass
from tests.drives.faults import jumped, shift
from tests.drives.slam import COARSE, calibrated, rounds, slam_drive
from tests.support.pose_errors import pose_nees, position_error
from tests.worlds.exact import dipole_world, random_sensors

WORLD, SENSORS = dipole_world(1), random_sensors(11, 2)
OPTIONS = SlamOptions.model_validate({"key_poses": COARSE})
ROWS = (70, 130, 190, 250, 310, 370, 430, 490)


def slipped(drive: Drive) -> list[int]:
    """Return the times of a drive's slips in nanoseconds."""
    believed = judged(drive, lambda each: localise_drive(each, WORLD, OPTIONS, silent)).drive
    return [int(drive.stamp_ns[each.step + 1]) for each in believed.jumps]


def test_slips_are_found_and_pivots_are_motion() -> None:
    """A vehicle turns by 12 degrees and moves by 12 cm within one step, and does or does not."""
    rng = np.random.default_rng(5)
    shifts = [shift(row, 0.12, 12 * rng.choice([-1, 1]), rng.uniform(-3, 3)) for row in ROWS]
    truth = jumped(rounds(30), *shifts[::2])
    drive = slam_drive(WORLD, SENSORS, truth, rng)
    odometry = jumped(drive.recording.trajectory, *shifts[1::2])
    recording = replace(drive.recording, trajectory=odometry)
    prepared_drive, _ = prepared(recording, calibrated(SENSORS), OPTIONS)
    assert len(prepared_drive.jumps) == len(ROWS)
    assert slipped(prepared_drive) == [int(odometry.stamp_ns[row + 1]) for row in ROWS[1::2]]


def test_a_pivot_is_not_reported_and_does_no_harm() -> None:
    truth = jumped(rounds(30), shift(250, 0.0, 15), shift(400, 0.15, -15))
    drive = slam_drive(WORLD, SENSORS, truth, np.random.default_rng(3))
    assert len(without_jumps(drive.recording.trajectory, JumpOptions()).jumps) == 2
    result = localise(drive.recording, WORLD, calibrated(SENSORS), OPTIONS, silent).result
    assert result.notes == ()
    assert position_error(drive.truth, result.trajectory) < 0.06
    assert pose_nees(drive.truth, result.trajectory).mean() < 12


@pytest.mark.study
@pytest.mark.parametrize("held_out", [1, 2, 3, 4])
def test_slips_of_a_real_robot(shared_data: Path, held_out: int) -> None:
    """Ten slips of 10 cm and 5 degrees in a pass, in the map of the others; its pivots are real."""
    passes = other_passes(shared_data, held_out)
    suite, field_map = passes.suite, passes.field_map
    options = SlamOptions.model_validate(
        {"key_poses": {"distance_m": 0.1, "readings": 1}, "calibration": "refined"}
    )
    run = robot_pass(shared_data, held_out)
    truth = run.trajectory[np.arange(0, len(run.trajectory), 5)]
    rng = np.random.default_rng(held_out)
    odometry = slipping(truth, rng)
    rows = np.sort(rng.choice(np.arange(10, len(odometry) - 10, 10), 10, replace=False))
    shifts = [shift(int(row), 0.1, 5 * rng.choice([-1, 1]), rng.uniform(-3, 3)) for row in rows]

    def slips(recording: Recording) -> set[int]:
        drive, _ = prepared(recording, suite, options)
        found = judged(drive, lambda each: localise_drive(each, field_map, options, silent)).drive
        return {int(found.stamp_ns[each.step + 1]) for each in found.jumps}

    plain, faulty = (
        replace(run, trajectory=each) for each in (odometry, jumped(odometry, *shifts))
    )
    assert slips(plain) == set()
    injected = set(odometry.stamp_ns[rows + 1].tolist())
    found = slips(faulty)
    assert found <= injected
    assert len(found) >= 9
    result = localise(faulty, field_map, suite, options, silent).result
    before, after = (position_error(truth, each) for each in (result.odometry, result.trajectory))
    nees = pose_nees(truth, result.trajectory).mean()
    print(f"{held_out}: {1e3 * before:.0f} -> {1e3 * after:.0f} mm, NEES {nees:.1f}, {len(found)}")
    assert after < 0.15 * before
    assert nees < 12

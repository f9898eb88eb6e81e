"""A drive in tiles: whether fields last."""

from dataclasses import replace

import gtsam
import numpy as np

from l2m_gtsam.progress import silent
from l2m_gtsam.slam.drive import EXACT_START
from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.unknown_field.tiled_stages import finds_changes, log_density, map_drive
from l2m_gtsam.slam.unknown_field.tiles import drive_prior
from tests.drives.moved_steel import moved_steel
from tests.drives.slam import SlamDrive, calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

QUICK = SlamOptions.model_validate(
    {
        "key_poses": {"distance_m": 0.3, "readings": 2},
        "tiles": {"modes": 100, "learn_over_m": 9.0},
    }
)


def test_only_where_steel_was_moved_visits_find_another_field() -> None:
    """At the true poses of four laps past a pallet, moved after the second or not."""
    made = moved_steel(2)

    def changes(each: SlamDrive) -> bool:
        drive, _ = prepared(each.recording, calibrated(made.sensors), QUICK)
        rows = np.searchsorted(each.truth.stamp_ns, drive.stamp_ns)
        truth = [gtsam.Pose3(gtsam.Rot3(each.truth.R[row]), each.truth.p[row]) for row in rows]
        return finds_changes(drive, truth, drive_prior(drive, truth, QUICK.tiles))

    assert not changes(made.still)
    assert changes(made.moved)


def test_a_drive_whose_field_lasts_is_solved_once() -> None:
    """And its density is above that of the same tiles with readings of another field."""
    own = random_sensors(2, 4)
    recorded = slam_drive(dipole_world(2), own, laps(36, (1.9, 1.4)), np.random.default_rng(2))
    drive, _ = prepared(recorded.recording, calibrated(own), QUICK)
    drive = replace(drive, start=replace(drive.start, covariance=EXACT_START))
    poses, stages = drive.dead_reckoning(), list[str]()
    prior = drive_prior(drive, poses, QUICK.tiles)

    def noted(stage: str, _done: float) -> None:
        stages.append(stage)

    found = map_drive(drive, poses, prior, QUICK, noted)
    assert set(stages) == {"following the drive", "solving poses and field"}  # no moved steel
    wrong = replace(drive.readings, field=drive.readings.field[::-1])
    other = map_drive(replace(drive, readings=wrong), poses, prior, QUICK, silent)
    used = found.solution.used | other.solution.used
    assert log_density(found, used) > log_density(other, used)

"""Tiles of a drive whose poses are further off than the field is linear over."""

from dataclasses import replace

import numpy as np
import pytest

from l2m_gtsam.slam.localisation import prepared
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field import revisited_tiles
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiles import anchor_tiles, drive_prior
from l2m_gtsam.studies.slam_array.odometry import slipping
from tests.drives.slam import calibrated, laps, slam_drive
from tests.worlds.exact import dipole_world, random_sensors

OPTIONS = SlamOptions.model_validate(
    {
        "key_poses": {"distance_m": 0.3, "readings": 2},
        "tiles": {"modes": 100, "learn_over_m": 9.0},
    }
)


def test_from_far_off_no_visit_is_believed_to_find_another_field(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Three laps of 10 m, and odometry that is a metre off after one: nothing was moved."""
    own, rng = random_sensors(4, 3), np.random.default_rng(4)
    recorded = slam_drive(dipole_world(4), own, laps(54, (1.9, 1.4)), rng)
    odometry = slipping(recorded.truth, rng, share=0.1)
    recording = replace(recorded.recording, trajectory=odometry)
    drive, _ = prepared(recording, calibrated(own), OPTIONS)
    poses = drive.dead_reckoning()
    prior = drive_prior(drive, poses, OPTIONS.tiles)
    motions = RelativeMotions.along(drive, poses)
    R = np.stack([pose.rotation().matrix() for pose in poses])
    p = np.stack([pose.translation() for pose in poses])

    def tiles() -> int:
        return len(TiledDrive.renewed(motions, poses, drive.sensors, prior).anchoring)

    assert tiles() == len(anchor_tiles(R, p, OPTIONS.tiles.core))
    monkeypatch.setattr(revisited_tiles, "MOST_CHANGED", 1.0)
    assert tiles() > len(anchor_tiles(R, p, OPTIONS.tiles.core))

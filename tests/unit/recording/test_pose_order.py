"""Poses that were written in another way than they are read are told, others are not."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.recording.pose_order import odd_order, order_notes

SECONDS = np.arange(0.0, 60.0, 0.1)
ANGLE = 2 * np.pi * SECONDS / 40.0
PLACE = np.column_stack([4 * np.sin(ANGLE), 3 * np.sin(2 * ANGLE), 0.8 + 0.02 * np.cos(ANGLE)])
VELOCITY = np.gradient(PLACE, axis=0)
HEADING = np.arctan2(VELOCITY[:, 1], VELOCITY[:, 0])


def poses(R: Rotation, p: FloatArray = PLACE) -> Trajectory:
    """Return a drive along a figure of eight, with noise of 2 mm."""
    noisy = p + 0.002 * np.random.default_rng(1).normal(size=p.shape)
    stamps = np.round(1e9 * SECONDS).astype(np.int64)
    return Trajectory(stamps, R.as_matrix(), noisy, "map", "lidar")


def turned(ahead: FloatArray) -> Rotation:
    """Return rotations of a vehicle that sways and moves along its axis at ``ahead`` (rad)."""
    sway = np.deg2rad(2.0) * np.sin(3 * ANGLE)
    return Rotation.from_euler("ZYX", np.column_stack([HEADING - ahead, sway, -sway]))


TRUE = turned(np.zeros(1))


def test_poses_as_they_are_read_are_not_told() -> None:
    shunting = np.where(SECONDS < 30, 0.0, np.pi)
    sideways = turned(np.full(1, 0.5 * np.pi))
    any_way = turned(0.7 * SECONDS)  # whatever its direction: one that moves in all of its own
    still = poses(TRUE, np.zeros_like(PLACE))
    for each in (poses(TRUE), poses(turned(shunting)), poses(sideways), poses(any_way), still):
        assert odd_order(each) == ""
        assert order_notes(Path("drive.tum"), each) == ()


@pytest.mark.parametrize(
    ("written", "told"),
    [
        (poses(TRUE.inv()), "rotations inverted (conjugate quaternions)"),
        (poses(Rotation.from_quat(TRUE.as_quat()[:, [3, 0, 1, 2]])), "in the order w, x, y, z"),
        (poses(TRUE.inv(), TRUE.inv().apply(-PLACE)), "poses of the map in the lidar's frame"),
    ],
)
def test_how_poses_seem_to_be_written_is_told(written: Trajectory, told: str) -> None:
    (line,) = order_notes(Path("drive.tum"), written)
    assert line.startswith("drive.tum: poses seem to be written in another way")
    assert told in line

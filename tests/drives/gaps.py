"""Drives whose odometry is silent for some time."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.geometry import between, compose
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.online.replay import Message, messages
from tests.drives.slam import SlamDrive

STILL = RigidTransform(np.eye(3), np.zeros(3))


def with_gap(
    drive: SlamDrive, rows: tuple[int, int], step: RigidTransform | None = None
) -> list[Message]:
    """Return a drive without odometry between two of its rows.

    Odometry has gone on meanwhile, or it says another step over the gap, from where all that
    follows continues.
    """
    odometry, found = drive.recording.trajectory, list[Message]()
    before, after = (RigidTransform(odometry.R[k], odometry.p[k]) for k in rows)
    for message in messages(drive.recording):
        if not isinstance(message, OdometryPose):
            found.append(message)
            continue
        row = int(np.searchsorted(odometry.stamp_ns, message.stamp_ns))
        if row >= rows[1] and step is not None:
            since = between(after, message.T)
            message = replace(message, T=compose(before, compose(step, since)))
        if not rows[0] < row < rows[1]:
            found.append(message)
    return found

"""What may go wrong on a drive: odometry that jumps, steel that appears."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import RigidTransform, Trajectory
from l2m_gtsam.geometry import compose
from tests.drives.slam import SlamDrive


@dataclass(frozen=True)
class Shift:
    """A jump: its step, and where it leads in the frame of the pose that was due."""

    row: int
    T: RigidTransform


def shift(row: int, metres: float, degrees: float, heading: float = 0.0) -> Shift:
    """Return a jump by some way along a heading (rad), and a turn."""
    R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    t = metres * np.array([np.cos(heading), np.sin(heading), 0.0])
    return Shift(row, RigidTransform(R, t))


def jumped(trajectory: Trajectory, *shifts: Shift) -> Trajectory:
    """Return a trajectory whose poses after some steps are all moved, rigidly."""
    R, p = trajectory.R.copy(), trajectory.p.copy()
    for each in shifts:
        k = each.row + 1
        due = RigidTransform(R[k], p[k])
        carry = compose(compose(due, each.T), due.inverse())
        R[k:] = carry.R @ R[k:]
        p[k:] = p[k:] @ carry.R.T + carry.t
    return replace(trajectory, R=R, p=p)


def opened(before: SlamDrive, after: SlamDrive, row: int) -> SlamDrive:
    """Return a drive that reads what one drive did, and from some reading on the other."""
    series = []
    for early, late in zip(before.recording.series, after.recording.series, strict=True):
        field = early.field.copy()
        field[row:] = late.field[row:]
        series.append(replace(early, field=field))
    return replace(before, recording=replace(before.recording, series=tuple(series)))

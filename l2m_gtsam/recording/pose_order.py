"""Poses that were written in another way than they are read.

Most vehicles move along one axis of their own. If a drive does so with its rotations inverted, or
with their quaternions read from w on, and not as they are, they were written so.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory

STEP_M = 0.2  # of path, over which a direction is taken: far more than the noise of poses
LEAST_STEPS = 30
# Share of the squared direction that lies along one axis of the vehicle: 0.98 and more of vehicles
# that steer. In a plane it is a half if the direction has nothing to do with the vehicle.
SCATTERED, ALONG_ONE = 0.9, 0.95
INVERTED = "rotations inverted (conjugate quaternions), or x and y of positions exchanged,"


def order_notes(path: Path, poses: Trajectory) -> tuple[str, ...]:
    """Return a sentence on poses of a file that seem to be written otherwise, if they do."""
    found = odd_order(poses)
    if not found:
        return ()
    line = (
        f"{path}: poses seem to be written in another way than they are read: with {found} the "
        "vehicle moves along one axis of its own, as they are it does not; x, y, z, w of the "
        "rotation that turns vectors of the lidar into the map is expected"
    )
    return (line,)


def odd_order(poses: Trajectory) -> str:
    """Return how poses seem to have been written, a clause; nothing if as they are read.

    Vehicles that move in all directions of their own show nothing.
    """
    rows = _steps(poses.p)
    if len(rows) < LEAST_STEPS:
        return ""
    p, R = poses.p[rows], Rotation.from_matrix(poses.R[rows])
    if _along_one_axis(R, p) > SCATTERED:
        return ""
    x, y, z, w = R.as_quat().T
    # What was read as x, y, z, w was written as w, x, y, z.
    from_w = Rotation.from_quat(np.column_stack([y, z, w, x]))
    from_map = R.inv().apply(-p)
    otherwise = {
        INVERTED: _along_one_axis(R.inv(), p),
        "quaternions in the order w, x, y, z": _along_one_axis(from_w, p),
        "poses of the map in the lidar's frame": _along_one_axis(R.inv(), from_map),
    }
    best = max(otherwise, key=otherwise.__getitem__)
    return best if otherwise[best] > ALONG_ONE else ""


def _steps(p: FloatArray) -> IntArray:
    """Return rows that are a step of path apart, of positions of shape (N, 3)."""
    path = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1)))
    return np.unique(np.searchsorted(path, np.arange(0.0, path[-1], STEP_M)))


def _along_one_axis(R: Rotation, p: FloatArray) -> float:
    """Return which share of the direction of motion lies along one axis of the body, 1/3 to 1."""
    steps = np.diff(p, axis=0)
    # At the beginning and at the end of each step: between them it turns.
    own = np.vstack([R[:-1].inv().apply(steps), R[1:].inv().apply(steps)])
    length = np.linalg.norm(own, axis=1)
    moving = length > STEP_M / 2  # where it stands the path is noise
    if moving.sum() < LEAST_STEPS:
        return 0.0
    direction = own[moving] / length[moving, None]
    return float(np.linalg.eigvalsh(direction.T @ direction / len(direction))[-1])

"""A scene of readings of one sensor along a lane, whatever the field."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.budget.processes import ReadingPlaces
from l2m_gtsam.data import FloatArray, Readings


def scene(seconds: FloatArray) -> ReadingPlaces:
    """Return readings at some times on the way along a lane of 20 m."""
    rng, count = np.random.default_rng(7), len(seconds)
    R = Rotation.from_euler("z", 0.3 * np.sin(0.2 * seconds)[:, None]).as_matrix()
    p = np.column_stack([0.1 * seconds, np.sin(0.05 * seconds), np.zeros(count)])
    readings = Readings(
        sensors=("mag",),
        sensor=np.zeros(count, dtype=np.int64),
        stamp_ns=(1e9 * seconds).astype(np.int64),
        R_map_lidar=R,
        p_map_lidar=p,
        field=np.zeros((count, 3)),
    )
    C = np.broadcast_to(np.eye(3) + 0.1 * rng.standard_normal((3, 3)), (count, 3, 3))
    t, slope = np.tile([0.3, 0.1, 0.2], (count, 1)), 5 * rng.standard_normal((count, 3, 3))
    return ReadingPlaces(readings, t, C, p, 20 * rng.standard_normal((count, 3)), slope)

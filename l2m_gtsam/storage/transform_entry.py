"""How a sensor's pose stands in a file: both directions and an example."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, RigidTransform


def transform_entry(T_lidar_mag: RigidTransform) -> dict[str, Any]:
    """Return both directions and a point in both frames, so that no convention is left to guess."""
    p_mag = np.array([0.1, 0.2, 0.3])
    p_lidar = T_lidar_mag.R @ p_mag + T_lidar_mag.t
    return {
        "T_lidar_mag": _direction(T_lidar_mag),
        "T_mag_lidar": _direction(T_lidar_mag.inverse()),
        "example": {
            "meaning": "one point in both frames: p_lidar = R_lidar_mag @ p_mag + t_lidar_mag",
            "p_mag": p_mag.tolist(),
            "p_lidar": p_lidar.tolist(),
        },
    }


def _direction(transform: RigidTransform) -> dict[str, list[float]]:
    return {
        "translation": transform.t.tolist(),
        "quaternion_xyzw": _quaternion(transform.R),
    }


def _quaternion(R: FloatArray) -> list[float]:
    if not np.isfinite(R).all():
        return [float("nan")] * 4
    return [float(q) for q in Rotation.from_matrix(R).as_quat(canonical=True)]

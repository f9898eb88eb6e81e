"""KISS-ICP, scan by scan."""

from typing import Any

import numpy as np

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import as_matrix, from_matrix
from l2m_gtsam.lidar.extra import library


class KissFollower:
    """Follows a lidar by KISS-ICP.

    Parameters
    ----------
    voxel_m
        Cells of its map in metres.
    range_m
        It forgets what is further away, metres.
    """

    def __init__(self, voxel_m: float, range_m: float) -> None:
        config = library("kiss_icp.config").KISSConfig()
        config.data.deskew = False  # scans come as if they had been taken at once
        config.data.min_range, config.data.max_range = 0.0, range_m
        config.mapping.voxel_size = voxel_m
        config.registration.max_num_threads = 1  # sums in one order: the same scans, the same poses
        self._kiss: Any = library("kiss_icp.kiss_icp").KissICP(config)

    def follow(self, points: FloatArray, expected: RigidTransform) -> RigidTransform:
        """Return the step to a scan from the one before.

        Parameters
        ----------
        points
            Of the scan in the lidar frame in metres, shape (N, 3).
        expected
            The step as it is expected; KISS-ICP's own guess takes scans for evenly spaced.
        """
        self._kiss.last_delta = as_matrix(expected)
        self._kiss.register_frame(points, np.zeros(0))
        return from_matrix(np.asarray(self._kiss.last_delta))

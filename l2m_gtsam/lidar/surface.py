"""Clouds that are ready to be registered: points, what is near each, and planes through them."""

from typing import Any

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.lidar.extra import library
from l2m_gtsam.lidar.information import Planes, fitted_planes

# Points that are smoothed at once.
PIECE_POINTS = 50_000
# Neighbours that a plane or a covariance is fitted to.
NEIGHBOURS = 15


class Surface:
    """A cloud that scans are registered on, or a scan that is.

    Parameters
    ----------
    points
        Finite points in metres, shape (N, 3).
    edge
        The cloud is thinned to a point per cell of this size in metres; 0 takes it as it is.
    """

    def __init__(self, points: FloatArray, edge: float = 0.0) -> None:
        gicp = library("small_gicp")
        cloud = gicp.PointCloud(points)
        self.cloud: Any = gicp.voxelgrid_sampling(cloud, edge) if edge and len(points) else cloud
        self.points: FloatArray = np.array(self.cloud.points()[:, :3])
        self.tree: Any = gicp.KdTree(self.cloud) if self.usable else None
        if self.usable:
            gicp.estimate_covariances(self.cloud, self.tree, NEIGHBOURS)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def usable(self) -> bool:
        """Whether there are points enough for a plane."""
        return len(self.points) > NEIGHBOURS

    def nearest(self, points: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return for places, shape (N, 3), the nearest points' rows and distances, (N,) each."""
        rows, squared = self.tree.batch_nearest_neighbor_search(points)
        return np.array(rows, dtype=np.int64), np.sqrt(np.array(squared))

    def planes(self, rows: IntArray) -> Planes:
        """Return the planes that fit the surface at some of its points."""
        found, _ = self.tree.batch_knn_search(self.points[rows], NEIGHBOURS)
        return fitted_planes(self.points[rows], self.points[np.array(found, dtype=np.int64)])


def smoothed(points: FloatArray) -> FloatArray:
    """Return points moved onto the planes that fit their neighbours, where these are flat.

    A wall that many scans saw is as thick as their noise. Points of another scan match the near
    side of it, so that they seem to fit better than they do, and hold their pose where it was.

    Parameters
    ----------
    points
        Of a cloud that was thinned, shape (N, 3), metres.
    """
    surface = Surface(points)
    if not surface.usable:
        return points
    moved = points.copy()
    for low in range(0, len(points), PIECE_POINTS):
        rows = np.arange(low, min(low + PIECE_POINTS, len(points)))
        planes = surface.planes(rows)
        off = np.einsum("ni,ni->n", planes.normal, points[rows] - planes.point)
        moved[rows] -= np.where(planes.flat, off, 0.0)[:, None] * planes.normal
    return moved

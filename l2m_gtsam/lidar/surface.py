r"""Clouds with planes through their points, and the information of matched planes about a pose.

Points p of a scan lie on planes with normals n through q: ``e = n . (T p - q)``. A right
perturbation (w, v) of T changes e by ``J (w, v)`` with ``J = [p x m, m]`` and ``m = R^T n``. With
independent errors of variance s^2 the information is ``sum J^T J / s^2``.

Normals are estimates. In a corridor their errors point along it, and ``sum J^T J`` seems to
measure what no wall shows: after a few thousand points, to a centimetre. The share of it that the
normals' errors explain, N, is known from the fit of each plane, and information counts as far as
it exceeds a multiple of that: with ``H v = mu N v``, ``mu`` becomes ``max(mu - NOISE_TIMES, 0)``.
"""

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy.linalg import eigh

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, RigidTransform
from l2m_gtsam.errors import LidarError

# 1 is expected where nothing but noise speaks; the estimate of N itself is good to a factor.
NOISE_TIMES = 3.0
# Neighbourhoods thicker than this share of their width are no planes: edges, bushes, people.
FLAT = 0.35
# Nor are those narrower than this share of it: a post, or one ring of a lidar, is a line, and any
# plane fits it.
NARROW = 0.3
# Neighbours further apart are of different things: rings of a lidar far down a corridor make planes
# across it, which move with the lidar and seem to hold it.
WIDEST_M = 0.8
# Of the largest information: what is smaller is rounding.
ROUNDING = 1e-12
# Points that are smoothed at once.
PIECE_POINTS = 50_000
# Neighbours that a plane or a covariance is fitted to.
NEIGHBOURS = 15


def library(name: str) -> Any:
    """Return a module of the extra.

    Raises
    ------
    LidarError
        It is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.split(".", maxsplit=1)[0]
        raise LidarError(
            f"poses from point clouds need {package}: pip install 'l2m_gtsam[lidar]'"
        ) from error


@dataclass(frozen=True)
class Planes:
    """Planes at N places of a surface.

    Attributes
    ----------
    point
        On them in metres, shape (N, 3).
    normal
        Unit normals, shape (N, 3).
    slope
        Two errors of each normal, one standard deviation each, as vectors in the plane, shape
        (N, 2, 3).
    flatness
        Thickness over width of the neighbourhood that each was fitted to, shape (N,); infinite
        where that is too wide for one plane, or a line.
    """

    point: FloatArray
    normal: FloatArray
    slope: FloatArray
    flatness: FloatArray

    @property
    def flat(self) -> BoolArray:
        """Which of them are planes, shape (N,)."""
        return np.asarray(self.flatness < FLAT)

    @classmethod
    def unfitted(cls, count: int) -> "Planes":
        """Return space for so many planes."""
        return cls(
            np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2, 3)), np.empty(count)
        )

    def __getitem__(self, rows: IntArray) -> "Planes":
        return Planes(self.point[rows], self.normal[rows], self.slope[rows], self.flatness[rows])

    def __setitem__(self, rows: IntArray, planes: "Planes") -> None:
        self.point[rows], self.normal[rows] = planes.point, planes.normal
        self.slope[rows], self.flatness[rows] = planes.slope, planes.flatness


def fitted_planes(point: FloatArray, neighbours: FloatArray) -> Planes:
    """Fit a plane to the neighbours of each point.

    Parameters
    ----------
    point
        Shape (N, 3), metres.
    neighbours
        K of each, itself among them, shape (N, K, 3).
    """
    middle = neighbours.mean(axis=1)
    centred = neighbours - middle[:, None]
    count = neighbours.shape[1]
    spread = np.einsum("nki,nkj->nij", centred, centred) / count
    values, vectors = np.linalg.eigh(spread)
    values = np.maximum(values, np.finfo(float).eps)
    thickness = values[:, :1] * count / (count - 3)  # three parameters were fitted
    sigma = np.sqrt(thickness / (count * values[:, 1:]))
    # A normal that is off by a right angle is not known at all.
    slope = np.minimum(sigma, 1.0)[:, :, None] * vectors[:, :, 1:].swapaxes(1, 2)
    flatness = np.sqrt(values[:, 0] / values[:, 2])
    width = np.linalg.norm(neighbours - point[:, None], axis=2).max(axis=1)
    narrow = values[:, 1] < NARROW**2 * values[:, 2]
    flatness[narrow | (width > WIDEST_M)] = np.inf
    return Planes(middle, vectors[:, :, 0], slope, flatness)


def distances(points: FloatArray, T: RigidTransform, planes: Planes) -> FloatArray:
    """Return how far points of a scan, shape (N, 3), are above their planes, shape (N,)."""
    off = points @ T.R.T + T.t - planes.point
    return np.asarray(np.einsum("ni,ni->n", planes.normal, off))


def plane_information(
    points: FloatArray, T: RigidTransform, planes: Planes, sigma: float
) -> FloatArray:
    """Return the information that matched planes give about a pose, shape (6, 6).

    Parameters
    ----------
    points
        Of the scan in the lidar frame in metres, shape (N, 3).
    T
        The lidar in the frame of the planes.
    planes
        One for each point.
    sigma
        Standard deviation of the distances in metres.
    """
    J = _jacobian(points, T, planes.normal)
    noise = np.vstack([_jacobian(points, T, planes.slope[:, k]) for k in (0, 1)])
    return _above_noise(_squared(J), _squared(noise)) / sigma**2


def plane_step(points: FloatArray, T: RigidTransform, planes: Planes) -> FloatArray:
    """Return the right perturbation that brings points nearest to their planes, shape (6,).

    To first order, and in the sense of least squares; zero along what the planes do not hold.
    Parameters are those of ``plane_information``.
    """
    J = _jacobian(points, T, planes.normal)
    size = np.maximum(np.linalg.norm(J, axis=0), np.finfo(float).tiny)
    step = np.linalg.lstsq(J / size, -distances(points, T, planes), rcond=1e-6)[0]
    return np.asarray(step / size)


def _jacobian(points: FloatArray, T: RigidTransform, vectors: FloatArray) -> FloatArray:
    turned = vectors @ T.R
    return np.hstack([np.cross(points, turned), turned])


def _squared(J: FloatArray) -> FloatArray:
    return np.asarray(J.T @ J)


def _above_noise(H: FloatArray, N: FloatArray) -> FloatArray:
    """Return what of H exceeds a multiple of N, both of shape (6, 6) and not negative."""
    size = np.sqrt(np.maximum(np.diagonal(H), np.finfo(float).tiny))
    scaled = H / np.outer(size, size)
    noise = N / np.outer(size, size) + ROUNDING * np.eye(6)
    mu, V = eigh(scaled, noise)
    back = np.linalg.inv(V)
    kept = back.T @ (np.maximum(mu - NOISE_TIMES, 0.0)[:, None] * back)
    return np.asarray(kept * np.outer(size, size))


def inflated(information: FloatArray, least: FloatArray) -> FloatArray:
    """Return information as it is if a covariance is added to the errors, both (6, 6).

    The same as ``inv(inv(information) + least)``, also for singular information.
    """
    weaker = np.linalg.solve(np.eye(6) + information @ least, information)
    return np.asarray((weaker + weaker.T) / 2)


class Surface:
    """A cloud that scans are registered on, or a scan that is.

    Planes that were asked for are kept, about 100 bytes each.

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
        self._planes = Planes.unfitted(len(self.points))
        self._fitted = np.zeros(len(self.points), dtype=np.bool_)
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
        """Return the planes that fit the surface at some of its points; each is fitted once."""
        new = np.unique(rows[~self._fitted[rows]])
        if len(new):
            self._planes[new] = self.fitted(new)
            self._fitted[new] = True
        return self._planes[rows]

    def fitted(self, rows: IntArray) -> Planes:
        """Return the same without keeping them."""
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
        planes = surface.fitted(rows)  # each once: a cloud may have millions
        off = np.einsum("ni,ni->n", planes.normal, points[rows] - planes.point)
        moved[rows] -= np.where(planes.flat, off, 0.0)[:, None] * planes.normal
    return moved

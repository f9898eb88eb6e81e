"""Which readings of a survey a map is made of: those around a drive, fewer of them."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.studies.site import Surveyed

LAYER = 0.2  # metres; less than the suite's sensors are apart in height, more than it heaves
CELL = 0.5  # metres; edge of the squares of which surveyed floor is counted


def around(site: Surveyed, path: FloatArray, distance: float) -> Surveyed:
    """Return the part of a site within a horizontal distance of a path.

    Parameters
    ----------
    site
        World and survey.
    path
        Places in the map frame in metres, shape (M, 3).
    distance
        Metres.
    """
    rows = np.flatnonzero(_near(site.survey.points, path, distance))
    cloud = site.cloud[_near(site.cloud, path, distance)]
    return replace(site, survey=site.survey[rows], cloud=cloud)


def thinned(site: Surveyed, spacing: float) -> Surveyed:
    """Return a site with fewer survey readings; see ``thinned_rows``."""
    return replace(site, survey=site.survey[thinned_rows(site.survey.points, spacing)])


def thinned_rows(points: FloatArray, spacing: float) -> IntArray:
    """Return the readings that are left if each cell of the floor keeps one at each height.

    Parameters
    ----------
    points
        Places of the readings in the map frame in metres, shape (N, 3).
    spacing
        Edge of the cells in metres, of which each keeps the reading next to its middle; 0 keeps
        all.

    Returns
    -------
    Rows, ascending, shape (M,).
    """
    if spacing == 0.0:
        return np.arange(len(points))
    cells = np.floor(points / [spacing, spacing, LAYER]).astype(np.int64)
    aside = points[:, :2] - (cells[:, :2] + 0.5) * spacing
    nearest_first = np.argsort(np.linalg.norm(aside, axis=1), kind="stable")
    _, first = np.unique(cells[nearest_first], axis=0, return_index=True)
    return np.sort(nearest_first[first])


def surveyed_floor(points: FloatArray) -> float:
    """Return the floor on which readings, shape (N, 3) in metres, were taken, square metres."""
    return float(len(np.unique(np.floor(points[:, :2] / CELL), axis=0)) * CELL**2)


def _near(points: FloatArray, path: FloatArray, distance: float) -> BoolArray:
    """Return which points, shape (N, 3), are within a horizontal distance of a path (M, 3)."""
    away, _ = cKDTree(path[:, :2]).query(points[:, :2])
    return np.asarray(away <= distance)

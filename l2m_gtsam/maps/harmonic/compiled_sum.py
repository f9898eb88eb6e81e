"""Predictions of a compiled tile at points, times its share, added up in one pass.

A drive asks hundreds of tiles for some tens of places each: calls and arrays in between took as
long as the sums.
"""

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.frame import clip_rows, write_local
from l2m_gtsam.maps.harmonic.near_sources import add_near
from l2m_gtsam.maps.harmonic.spline import spline_derivatives


@njit(cache=True, nogil=True)
def add_compiled(
    points: FloatArray,
    rows: IntArray,
    share: FloatArray,
    frame: tuple[FloatArray, FloatArray],
    walls: tuple[FloatArray, FloatArray],
    grid: tuple[FloatArray, float, FloatArray],
    near: tuple[FloatArray, tuple[int, int, int], IntArray, FloatArray],
    field: FloatArray,
    gradient: FloatArray,
    missing: IntArray,
) -> int:
    """Add field and gradient of a tile, times its share, at some points.

    Parameters
    ----------
    points
        In the map frame in metres, shape (N, 3).
    rows, share
        Which of them are asked for, shape (K,), and the tile's share in each, shape (K,) or longer.
    frame
        The tile's corner in metres, shape (3,), and axes, shape (3, 3); see ``TileFrame``.
    walls
        Lowest and highest coordinates in the tile's frame, metres, shape (3,); points beyond are
        moved there.
    grid
        Lower corner, spacing and coefficients; see ``PotentialGrid``.
    near
        Corner, shape, starts and table; see ``NearSources``.
    field, gradient
        In the map frame in uT and uT/m, shapes (N, 3) and (N, 3, 3); are added to.
    missing
        Which of ``rows`` the grid does not cover, shape (K,); nothing is added there.

    Returns
    -------
    int
        Number of rows that the grid does not cover.
    """
    corner, R = frame
    local, count = np.empty((len(rows), 3)), 0
    for k in range(len(rows)):
        for i in range(3):
            local[k, i] = points[rows[k], i]
    write_local(local, corner, R, local)
    clip_rows(local, walls[0], walls[1], local)
    B, G = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
    lower, spacing, coefficients = grid
    spline_derivatives(local, lower, spacing, coefficients, B, G)
    near_corner, shape, starts, table = near
    add_near(local, near_corner, shape, starts, table, B, G)
    half = np.empty((3, 3))
    for k in range(len(rows)):
        if np.isnan(B[k, 0]):
            missing[count] = k
            count += 1
            continue
        n, weight = rows[k], share[k]
        for i in range(3):
            field[n, i] += weight * (R[i, 0] * B[k, 0] + R[i, 1] * B[k, 1] + R[i, 2] * B[k, 2])
            for j in range(3):
                half[i, j] = R[i, 0] * G[k, 0, j] + R[i, 1] * G[k, 1, j] + R[i, 2] * G[k, 2, j]
        for i in range(3):
            for j in range(3):
                turned = half[i, 0] * R[j, 0] + half[i, 1] * R[j, 1] + half[i, 2] * R[j, 2]
                gradient[n, i, j] += weight * turned
    return count

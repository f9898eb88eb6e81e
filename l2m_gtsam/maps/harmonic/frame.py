"""The frame of a tile: a box whose floor may be tilted."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from l2m_gtsam.data import FloatArray

# A plane is worth following where it explains most of the heights and is steeper than a degree.
LEAST_SHARE = 0.5
LEAST_SLOPE = 0.02
MOST_SLOPE = 0.3  # two lanes at different heights are no ramp


@dataclass(frozen=True)
class TileFrame:
    """A box with its own axes; x and y run along its floor from one corner.

    Attributes
    ----------
    R_map_tile
        Axes of the box in the map frame, shape (3, 3).
    corner
        Its lower corner in the map frame in metres, shape (3,).
    size
        Extent along the box's x and y in metres, shape (2,).
    height
        Height of the highest reading over the lowest in metres; the lowest is at z = 0.
    """

    R_map_tile: FloatArray
    corner: FloatArray
    size: FloatArray
    height: float

    def localise(self, points: FloatArray) -> FloatArray:
        """Return points of the map frame, shape (N, 3), in the box's frame."""
        local = np.empty((len(points), 3))
        write_local(points, self.corner, self.R_map_tile, local)
        return local


def tile_frame(points: FloatArray, centre: FloatArray, size: float) -> TileFrame:
    """Return the frame of a square box around a centre, level or along its readings' plane.

    Parameters
    ----------
    points
        Positions of the readings in the box in metres, shape (N, 3).
    centre
        Its middle in the map frame's x and y in metres, shape (2,).
    size
        Its edge in metres.
    """
    R = floor_axes(points)
    middle = np.append(centre, points[:, 2].mean())
    local = (points - middle) @ R
    low, high = local[:, 2].min(), local[:, 2].max()
    corner = middle + R @ np.array([-size / 2, -size / 2, low])
    return TileFrame(R, corner, np.array([size, size]), float(high - low))


def floor_axes(points: FloatArray) -> FloatArray:
    """Return the axes of the readings' plane if they follow one that is not level, (3, 3)."""
    centred = points - points.mean(axis=0)
    # Least squares in z: a floor is never near vertical.
    slope, *_ = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)
    left = centred[:, 2] - centred[:, :2] @ slope
    level = not LEAST_SLOPE <= np.linalg.norm(slope) <= MOST_SLOPE
    if level or left @ left > (1 - LEAST_SHARE) * (centred[:, 2] @ centred[:, 2]):
        return np.eye(3)
    z = np.array([-slope[0], -slope[1], 1.0]) / np.hypot(1.0, np.linalg.norm(slope))
    y = np.cross(z, [1.0, 0.0, 0.0])
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])


@njit(cache=True, nogil=True)
def write_local(
    points: FloatArray, corner: FloatArray, R_map_tile: FloatArray, local: FloatArray
) -> None:
    """Write points (N, 3) of the map frame in a box's frame; numpy takes ten times as long."""
    R = R_map_tile
    for n in range(len(points)):
        x, y, z = points[n, 0] - corner[0], points[n, 1] - corner[1], points[n, 2] - corner[2]
        for i in range(3):
            local[n, i] = x * R[0, i] + y * R[1, i] + z * R[2, i]


@njit(cache=True, nogil=True)
def clip_rows(points: FloatArray, low: FloatArray, high: FloatArray, clipped: FloatArray) -> None:
    """Write points (N, 3) moved into a box; numpy takes ten times as long."""
    for n in range(len(points)):
        for i in range(3):
            clipped[n, i] = min(max(points[n, i], low[i]), high[i])

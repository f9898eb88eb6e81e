"""Steel that is brought to a hall: magnetised boxes of known moment, by magpylib."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.world import SteelWorld

MU_0 = 4e-7 * np.pi  # V s / (A m)


def brought_steel(positions: FloatArray, moments: FloatArray, edges: FloatArray) -> SteelWorld:
    """Return steel without the Earth's field: what it adds to that of a hall.

    Parameters
    ----------
    positions
        Of its K middles in the map in metres, shape (K, 3).
    moments
        Map frame in A m^2, shape (K, 3); the opposite of one is that it was taken away.
    edges
        Lengths along the map's axes in metres, shape (3,).
    """
    count = len(positions)
    return SteelWorld(
        kinds=("brought",) * count,
        dimensions=np.tile(edges, (count, 1)),
        centres=positions,
        R_map_body=np.tile(np.eye(3), (count, 1, 1)),
        polarisations=MU_0 * moments / float(np.prod(edges)),
        earth=np.zeros(3),
    )


def place_beside(
    path: FloatArray, others: FloatArray, distance: float, rng: np.random.Generator
) -> FloatArray:
    """Return a place whose nearest reading is at a distance, metres, shape (3,).

    Parameters
    ----------
    path
        Where readings are taken in metres, shape (N, 3).
    others
        Places that it keeps a metre from, shape (K, 3).
    distance
        From the nearest reading in metres.
    rng
        Draws the place.
    """
    best: FloatArray = path[0]
    least = np.inf
    for _ in range(TRIES):
        away = rng.standard_normal(3) * np.array([1.0, 1.0, 0.4])
        place = path[rng.integers(len(path))] + distance * away / np.linalg.norm(away)
        off = abs(float(np.linalg.norm(path - place, axis=1).min()) - distance)
        crowded = len(others) and float(np.linalg.norm(others - place, axis=1).min()) < APART_M
        if off < least and place[2] > 0 and not crowded:
            best, least = place, off
        if least < CLOSE_M:
            break
    return best


TRIES = 400
CLOSE_M, APART_M = 0.03, 1.0

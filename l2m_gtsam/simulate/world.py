"""A world of magnetised bodies in a uniform field, computed exactly; and steel brought to it."""

from dataclasses import dataclass

import numpy as np
from magpylib.core import magnet_cuboid_Bfield

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.parallel.threads import in_threads

MICROTESLA_PER_TESLA = 1e6
PAIRS_PER_BATCH = 4_000  # of a body and a point: intermediate arrays of 2 MB stay in cache
MU_0 = 4e-7 * np.pi  # V s / (A m)
TRIES = 400  # of a place beside a path
CLOSE_M, APART_M = 0.03, 1.0  # of its distance, and from other places


@dataclass(frozen=True)
class SteelWorld:
    """Homogeneously magnetised cuboids in the Earth's field.

    Attributes
    ----------
    kinds
        What each body is ("post", "rebar", ...), one name per body.
    dimensions
        Lengths of the sides along the body's own axes in metres, shape (N, 3).
    centres
        Centres in the map in metres, shape (N, 3).
    R_map_body
        Rotations from body to map, shape (N, 3, 3).
    polarisations
        Magnetic polarisation J = mu0 M in the body's own axes in tesla, shape (N, 3).
    earth
        Uniform field in the map frame in microtesla, shape (3,).
    """

    kinds: tuple[str, ...]
    dimensions: FloatArray
    centres: FloatArray
    R_map_body: FloatArray
    polarisations: FloatArray
    earth: FloatArray

    def __len__(self) -> int:
        return len(self.kinds)

    def field(self, points: FloatArray) -> FloatArray:
        """Return the magnetic field at points of the map.

        The exact field of every body is summed (surface charges, as `magpylib` gives it);
        nothing is approximated by distance. Batches are shared among the machine's cores, and
        the result does not depend on how many there are.

        Parameters
        ----------
        points
            Positions in the map in metres, shape (P, 3).

        Returns
        -------
        Field in the map frame in microtesla, shape (P, 3).
        """
        parts = in_threads(self._steel_field, self._batches(points))
        return np.asarray(self.earth + np.concatenate([np.zeros((0, 3)), *parts]))

    def inside(self, points: FloatArray) -> BoolArray:
        """Return which points, shape (P, 3) in metres, lie within a body, shape (P,)."""
        parts = [self._inside_any(batch) for batch in self._batches(points)]
        return np.concatenate([np.zeros(0, dtype=np.bool_), *parts])

    def _batches(self, points: FloatArray) -> list[FloatArray]:
        """Return the points in parts whose intermediate arrays stay small."""
        size = max(1, PAIRS_PER_BATCH // max(1, len(self)))
        return [points[low : low + size] for low in range(0, len(points), size)]

    def _inside_any(self, points: FloatArray) -> BoolArray:
        within = np.abs(self._in_bodies(points)) <= self.dimensions[:, None] / 2
        return np.asarray(np.any(np.all(within, axis=2), axis=0))

    def _in_bodies(self, points: FloatArray) -> FloatArray:
        """Return every point in every body's frame in metres, shape (N, P, 3)."""
        return np.asarray((points - self.centres[:, None]) @ self.R_map_body)

    def _steel_field(self, points: FloatArray) -> FloatArray:
        """Return the field of all bodies in the map frame in microtesla, shape (P, 3)."""
        shape = (len(self), len(points), 3)
        field = magnet_cuboid_Bfield(
            observers=self._in_bodies(points).reshape(-1, 3),
            dimensions=np.broadcast_to(self.dimensions[:, None], shape).reshape(-1, 3),
            polarizations=np.broadcast_to(self.polarisations[:, None], shape).reshape(-1, 3),
        ).reshape(shape)
        in_map = (field @ self.R_map_body.transpose(0, 2, 1)).sum(axis=0)
        return np.asarray(in_map * MICROTESLA_PER_TESLA)


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

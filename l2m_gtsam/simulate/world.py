"""A world of magnetised bodies in a uniform field, computed exactly."""

from dataclasses import dataclass

import numpy as np
from magpylib.core import magnet_cuboid_Bfield

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.parallel.threads import in_threads

MICROTESLA_PER_TESLA = 1e6
PAIRS_PER_BATCH = 4_000  # of a body and a point: intermediate arrays of 2 MB stay in cache


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

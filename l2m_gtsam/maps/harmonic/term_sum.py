"""The exact field of one tile, summed term by term: for places that no grid covers.

All dipoles of a tile are one sum, in place of one for each structure: with a few points in each of
many tiles, calls would take ten times as long as the sums.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.dipoles import Dipoles, add_dipoles
from l2m_gtsam.maps.harmonic.family import Family
from l2m_gtsam.maps.harmonic.near_sources import PointSources
from l2m_gtsam.maps.harmonic.tile import Tile


@dataclass(frozen=True)
class TermSum:
    """All terms of a tile, in its own frame.

    Attributes
    ----------
    sources
        All dipoles, tile frame, metres and uT m^3.
    others
        All other families with their weights.
    """

    sources: PointSources
    others: tuple[tuple[Family, FloatArray], ...]

    @classmethod
    def of(cls, tile: Tile, sources: PointSources) -> "TermSum":
        """Return the terms of a tile with the mean of its weights, and all of its dipoles."""
        families = zip(tile.basis.families, tile.basis.columns, strict=True)
        others = ((f, tile.weights.mean[at]) for f, at in families if not isinstance(f, Dipoles))
        return cls(sources, tuple(others))

    def field_and_gradient(self, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m in the tile's frame."""
        field, gradient = np.zeros((len(local), 3)), np.zeros((len(local), 3, 3))
        for family, weights in self.others:
            part_field, part_gradient = family.field_and_gradient(local, weights)
            field += part_field
            gradient += part_gradient
        add_dipoles(local, self.sources.positions, self.sources.moments, field, gradient)
        return field, gradient

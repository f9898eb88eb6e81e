"""All families of features of one tile, in the map frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, compress

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.family import Family, Hyperparameters, WeightPrior
from l2m_gtsam.maps.harmonic.frame import TileFrame, turn_rows

BATCH = 512  # points whose features are in memory, and about in cache, at once


@dataclass(frozen=True)
class Basis:
    """Features of a tile: m weights in the order of the families.

    Attributes
    ----------
    frame
        The tile's box and axes in the map frame, metres.
    families
        Families of features, m weights in total, each with its own prior.
    """

    frame: TileFrame
    families: tuple[Family, ...]

    def __len__(self) -> int:
        return self.columns[-1].stop if self.families else 0

    def of_kind(self, kind: type[Family]) -> tuple["Basis", IntArray]:
        """Return the part of one kind of families, and its columns in the whole."""
        chosen = [isinstance(family, kind) for family in self.families]
        columns = [range(c.start, c.stop) for c, on in zip(self.columns, chosen, strict=True) if on]
        part = Basis(self.frame, tuple(compress(self.families, chosen)))
        return part, np.array(list(chain(*columns)), dtype=np.int64)

    def prior(self, hyperparameters: Hyperparameters) -> WeightPrior:
        """Return the prior of all weights."""
        priors = [family.prior(hyperparameters) for family in self.families]
        log_variance = np.concatenate([np.empty(0), *(prior.log_variance for prior in priors)])
        slopes: dict[str, FloatArray] = {}
        m = len(self)
        for columns, prior in zip(self.columns, priors, strict=True):
            for name, slope in prior.slopes.items():
                slopes.setdefault(name, np.zeros(m))[columns] = slope
        return WeightPrior(log_variance, slopes)

    def features(self, points: FloatArray) -> FloatArray:
        """Return the field of each weight in the map frame, uT per unit, shape (N, 3, m)."""
        return np.ascontiguousarray(self.rows(points, np.ones(len(self))).transpose(2, 1, 0))

    def rows(self, points: FloatArray, units: FloatArray) -> FloatArray:
        """Return the field in uT that so many units of each weight make, weight by weight.

        Parameters
        ----------
        points
            In the map frame in metres, shape (N, 3).
        units
            Factor of each weight's field, shape (m,).

        Returns
        -------
        FloatArray
            Along the axes of the map frame, shape (m, 3, N): a weight's numbers lie together, as
            solves with the factor of their covariance want them.
        """
        local = self.frame.localise(points)
        rows = np.empty((len(self), 3, len(points)))
        for columns, family in zip(self.columns, self.families, strict=True):
            family.write_rows(local, units[columns], rows[columns])
        if not np.array_equal(self.frame.R_map_tile, np.eye(3)):
            turn_rows(self.frame.R_map_tile, rows)
        return rows

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m in the map frame."""
        field, gradient = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        R = self.frame.R_map_tile
        for at in batches(len(points)):
            local = self.frame.localise(points[at])
            parts = [
                family.field_and_gradient(local, weights[columns])
                for family, columns in zip(self.families, self.columns, strict=True)
            ]
            field[at] = sum(part[0] for part in parts) @ R.T
            # A gradient turns with the field's components and with the direction of the derivative.
            gradient[at] = R @ sum(part[1] for part in parts) @ R.T
        return field, gradient

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Columns of each family."""
        ends = np.cumsum([len(family) for family in self.families]).tolist()
        return tuple(slice(end - len(f), end) for end, f in zip(ends, self.families, strict=True))


def batches(count: int) -> Iterator[slice]:
    """Yield slices that cover so many points."""
    for start in range(0, count, BATCH):
        yield slice(start, min(start + BATCH, count))

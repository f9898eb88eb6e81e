"""The readings of a stretch of a drive in one tile: how far each counts, and their factors."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_factors import TileBatch, Whitening, doubt_factor, tile_factor
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.localised import NOTHING
from l2m_gtsam.slam.map_prediction import Sight
from l2m_gtsam.slam.unknown_field.field_memory import ExploredTile
from l2m_gtsam.slam.unknown_field.tiled import LaidTile
from l2m_gtsam.solve.robust import WEIGHTS, RobustOptions


@dataclass(frozen=True)
class TileReadings:
    """Those of n readings that count.

    Attributes
    ----------
    laid
        The tile with all of them.
    chosen
        Which count, shape (c,).
    whitening
        Of these, times the roots of their weights, 1/uT, shape (c, 3, 3).
    variance
        Of their noise per axis with what the tile leaves out, over their weights, uT^2, (c, 3).
    """

    laid: LaidTile
    chosen: IntArray
    whitening: FloatArray
    variance: FloatArray

    @classmethod
    def weighed(
        cls,
        laid: LaidTile,
        sight: Sight,
        noise: FloatArray,
        mu: FloatArray,
        robust: RobustOptions,
    ) -> "TileReadings":
        """Weigh readings by what a tile says of them.

        Parameters
        ----------
        laid, sight
            The tile and what it says.
        noise
            Of each reading in uT, shape (n,).
        mu
            How sharply good ones are told from wrong ones, see ``solve.robust``, shape (n,).
        robust
            How readings are treated that nothing explains.
        """
        W = sight.whitening_of(noise)
        r2, weights = sight.squared(W), np.empty(len(mu))
        for stage in np.unique(mu):
            own = mu == stage
            weights[own] = WEIGHTS[robust.loss](r2[own], robust.largest, stage)
        chosen = np.flatnonzero(weights > NOTHING)
        W = W[chosen] * np.sqrt(weights[chosen])[:, None, None]
        variance = noise[:, None] ** 2 + laid.field.unresolved(laid.place.x)
        return cls(laid, chosen, W, variance[chosen] / weights[chosen, None])

    def factors(self, drive: Drive) -> Iterator[gtsam.NonlinearFactor]:
        """Yield what they say of poses and weights."""
        batch = self._batch(drive)
        for k in batch.key_poses:
            white = Whitening.independent(self.whitening[batch.rows_of(k)])
            yield tile_factor(batch, k, white)

    def doubts(self, drive: Drive, tile: ExploredTile) -> Iterator[gtsam.NonlinearFactor]:
        """Yield what keeps poses from where the tile would take up more noise."""
        if not len(self.chosen):
            return
        batch, x = self._batch(drive), self.laid.place.x[self.chosen]
        doubt = self.laid.field.doubt(x, self.variance, tile.taught)
        for k in batch.key_poses:
            factor = doubt_factor(batch, k, doubt[batch.rows_of(k)])
            if factor is not None:
                yield factor

    def information(self) -> FloatArray:
        """Return what they tell of the tile's m weights, shape (m, m)."""
        return self.laid.field.information(self.laid.place.x[self.chosen], self.variance)

    def _batch(self, drive: Drive) -> TileBatch:
        readings = drive.readings[self.laid.rows[self.chosen]]
        return TileBatch(
            self.laid.number, self.laid.anchor, self.laid.field, readings, drive.sensors.fixed()
        )

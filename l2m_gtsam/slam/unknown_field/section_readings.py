"""The readings of a section, tile by tile, with their robust weights."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_factors import Calibrations, KeyPoseReadings, TileBlocks
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.map_prediction import MapPrediction
from l2m_gtsam.slam.pose_graph import successive
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.unknown_field.field_memory import RememberedTile
from l2m_gtsam.slam.unknown_field.linear_field import AXES
from l2m_gtsam.slam.unknown_field.tiled_drive import OccupiedTile
from l2m_gtsam.solve.robust import WEIGHTS, RobustOptions


@dataclass(frozen=True)
class SectionReadings:
    """Readings of a section so far, and their sensors' calibrations; None where these are free."""

    readings: KeyPoseReadings
    fixed: Calibrations | None


@dataclass(frozen=True)
class TileReadings:
    """The readings of a tile that count, of n.

    Attributes
    ----------
    laid
        The tile with all n readings.
    chosen
        Rows of those that count, shape (c,).
    variance
        Per axis of noise and unresolved waves, over their weights, uT^2, shape (c, 3).
    blocks
        Those that count, white times the roots of their weights.
    """

    laid: OccupiedTile
    chosen: IntArray
    variance: FloatArray
    blocks: TileBlocks

    @classmethod
    def weighed(
        cls,
        of_section: SectionReadings,
        laid: OccupiedTile,
        prediction: MapPrediction,
        noise: FloatArray,
        mu: FloatArray,
        robust: RobustOptions,
        times: int = 1,
    ) -> "TileReadings":
        """Return the robust weights of readings by a tile's prediction.

        Parameters
        ----------
        of_section
            All readings of the section.
        laid, prediction
            The tile and its prediction.
        noise
            Standard deviation of each reading in uT, shape (n,).
        mu
            Convexity of the loss for each reading, see ``solve.robust``, shape (n,).
        robust
            Loss and confidence.
        times
            How often what the waves leave out counts.
        """
        W = prediction.whitening_of(noise)
        r2, weights = prediction.squared(W), np.empty(len(mu))
        for stage in np.unique(mu):
            own = mu == stage
            weights[own] = WEIGHTS[robust.loss](r2[own], robust.largest, stage)
        # A reading is judged by itself; those that count share what the waves leave out.
        chosen = np.flatnonzero(weights > REJECTED_WEIGHT)
        unresolved = np.zeros((len(mu), AXES))
        unresolved[chosen] = times * laid.field.unresolved_together(laid.placed.x[chosen])
        variance = noise[:, None] ** 2 + unresolved
        W = prediction.whitening_of(noise, unresolved)[chosen]
        W *= np.sqrt(weights[chosen])[:, None, None]
        readings = of_section.readings[laid.rows[chosen]]
        blocks = TileBlocks(laid.number, laid.anchor, laid.field, readings, W, of_section.fixed)
        return cls(laid, chosen, variance[chosen] / weights[chosen, None], blocks)

    def log_volume(self, sensors: KnownSensors, largest: float) -> float:
        """Return what the log likelihood of the n readings has beside squares of their residuals.

        Each is counted against an outlier, which is as likely as a reading at the end of what
        passes for noise.

        Parameters
        ----------
        sensors
            Calibrations.
        largest
            Squared length of a whitened residual at that end.
        """
        noise = sensors.noise[self.laid.placed.readings.sensor[self.chosen]]
        return float(
            AXES * np.log(noise).sum()
            - 0.5 * np.log(self.variance).sum()
            + 0.5 * largest * len(self.chosen)
        )

    def factors(self) -> Iterator[gtsam.NonlinearFactor]:
        """Yield the readings' factors of poses and weights."""
        for together in successive(self.blocks.key_poses):
            for residual in self.blocks.white_residuals(together):
                yield residual.factor()

    def penalties(self, tile: RememberedTile) -> Iterator[gtsam.NonlinearFactor]:
        """Yield the penalties of the parameters that the readings determine."""
        if not len(self.chosen):
            return
        x = self.laid.placed.x[self.chosen]
        penalty = self.laid.field.penalty(x, self.variance, tile.past_information)
        for together in successive(self.blocks.key_poses):
            residual = self.blocks.penalty(together, penalty)
            if residual is not None:
                yield residual.factor()

    def information(self) -> FloatArray:
        """Return the readings' information about the tile's m weights, shape (m, m)."""
        return self.laid.field.information(self.laid.placed.x[self.chosen], self.variance)

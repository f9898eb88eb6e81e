r"""Visits of a tile that found another field there: steel was moved between two laps.

Readings of a visit differ from the field that earlier ones left for two reasons: the vehicle was
not where it is believed to have been, by one rigid motion as far as a tile is concerned, or the
field has changed. Both are asked of the same readings,

.. math::
    b = F w + D \xi + v \quad \text{or} \quad b = F (w + \delta) + D \xi + v

with w as earlier visits know it, xi the motion and delta a change as the prior of the waves has it,
but smaller: as large as makes the readings most likely. What is known of the motion otherwise, by
odometry and by other tiles, is that of ``visit_graph``.
"""

from dataclasses import dataclass
from typing import Self

import gtsam
import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, eigh, solve_triangular

from l2m_factors import skew
from l2m_gtsam.data import FloatArray, IntArray, RowTable
from l2m_gtsam.slam.unknown_field.linear_field import LinearField

SHARES = (0.0, 0.003, 0.01, 0.03, 0.1)  # of a change, over the prior of the waves
SPIKE = 6.0  # sigmas from the field of the others, beyond which a reading is none of the field
MOTION = np.repeat([np.deg2rad(5.0), 0.3], 3)  # what is known of xi at least, rad and metres


@dataclass(frozen=True)
class Seen(RowTable):
    """Readings of a tile in the frame of its anchor.

    Attributes
    ----------
    points, field
        Where, metres, and what, uT, shapes (n, 3).
    variance
        Of each reading per axis, uT^2, shape (n, 3).
    key_pose
        Number of the key pose that each hangs on, shape (n,).
    """

    points: FloatArray
    field: FloatArray
    variance: FloatArray
    key_pose: IntArray

    def __len__(self) -> int:
        return len(self.points)

    def thinned(self, most: int) -> "Seen":
        """Return so many of them at most, evenly spread."""
        rows = np.linspace(0, len(self) - 1, min(len(self), most)).astype(np.int64)
        return self[np.unique(rows)]


@dataclass(frozen=True)
class Information:
    """What is known of k numbers, in information form.

    Attributes
    ----------
    information, pulled
        Shapes (k, k) and (k,).
    """

    information: FloatArray
    pulled: FloatArray

    def __add__(self, other: Self) -> Self:
        """Return what both say."""
        return type(self)(self.information + other.information, self.pulled + other.pulled)


class Remembered(Information):
    """What readings say of a tile's weights, besides their prior: sums over readings."""

    @classmethod
    def of(cls, tile: LinearField, seen: Seen) -> "Remembered":
        """Return what readings say."""
        root = 1 / np.sqrt(seen.variance)
        white = (tile.features(seen.points) * root[:, :, None]).reshape(-1, len(tile))
        return cls(white.T @ white, white.T @ (seen.field * root).ravel())

    @property
    def evidence(self) -> float:
        """How likely the readings are, weights integrated out, less what they are without field."""
        lower = cholesky(self.information + np.eye(len(self.pulled)), lower=True)
        c = solve_triangular(lower, self.pulled, lower=True)
        return float(0.5 * (c @ c) - np.log(np.diag(lower)).sum())


@dataclass(frozen=True)
class EarlierField:
    """A tile's m weights as earlier visits know them.

    Attributes
    ----------
    mean
        Shape (m,).
    axes, variance
        Of their covariance: columns are directions, shape (m, m), with variances, shape (m,).
    """

    mean: FloatArray
    axes: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, earlier: Remembered) -> "EarlierField":
        """Return the weights by what earlier visits remember, and their prior."""
        known, axes = eigh(earlier.information)
        variance = 1 / (1 + np.maximum(known, 0.0))
        return cls(axes @ (variance * (axes.T @ earlier.pulled)), axes, variance)


@dataclass(frozen=True)
class VisitResiduals:
    """What a visit's readings differ from the field of earlier visits by.

    Attributes
    ----------
    left
        In the anchor's frame, uT, shape (n, 3).
    by_motion
        What a motion takes off, per rad and metre, shape (n, 3, 6).
    features
        The field of the weights, shape (n, 3, m).
    """

    left: FloatArray
    by_motion: FloatArray
    features: FloatArray

    @classmethod
    def of(
        cls, tile: LinearField, earlier: EarlierField, visit: Seen, node: gtsam.Pose3
    ) -> "VisitResiduals":
        """Return them.

        Parameters
        ----------
        tile, earlier, visit
            As of ``VisitEvidence.of``.
        node
            Pose in the anchor's frame that the motion is a right perturbation of.
        """
        R, p = node.rotation().matrix(), node.translation()
        field, gradient = tile.field_and_gradient(visit.points, earlier.mean)
        # A turned vehicle reads another field, and elsewhere.
        turned = skew(visit.field) - gradient @ skew(visit.points - p)
        D = np.concatenate([turned @ R, gradient @ R], axis=2)
        return cls(visit.field - field, D, tile.features(visit.points))


class Motion(Information):
    """A motion of six numbers: a right perturbation of a pose."""


@dataclass(frozen=True)
class VisitEvidence:
    """What a visit says of its motion, for each of ``SHARES``.

    Attributes
    ----------
    motions
        Of each share.
    constant
        Likelihood without any motion, in nats but for a constant that all shares have.
    """

    motions: tuple[Motion, ...]
    constant: FloatArray

    @classmethod
    def of(
        cls, tile: LinearField, earlier: EarlierField, visit: Seen, node: gtsam.Pose3
    ) -> "VisitEvidence":
        """Return what a visit says.

        Parameters
        ----------
        tile
            Waves of the tile, of unit prior variance.
        earlier
            What earlier visits know of it.
        visit
            Its readings.
        node
            Pose in the anchor's frame that the motion is of.
        """
        own, root = VisitResiduals.of(tile, earlier, visit, node), 1 / np.sqrt(visit.variance)
        X = np.concatenate([own.left[:, :, None], own.by_motion], axis=2)
        X = (X * root[:, :, None]).reshape(-1, 7)
        F = (own.features * root[:, :, None]).reshape(-1, len(tile)) @ earlier.axes
        seen, by_weights, alone = F.T @ F, F.T @ X, X.T @ X
        motions, constant = [], []
        for share in SHARES:
            # By Woodbury: weights as earlier visits and a change leave them, and noise.
            prior = earlier.variance + share**2
            factor = cho_factor(seen + np.diag(1 / prior))
            squared = alone - by_weights.T @ cho_solve(factor, by_weights)
            log_det = float(np.log(prior).sum() + 2 * np.log(np.diag(factor[0])).sum())
            motions.append(Motion(squared[1:, 1:], squared[1:, 0]))
            constant.append(-0.5 * (float(squared[0, 0]) + log_det))
        return cls(tuple(motions), np.array(constant))

    def followed_by(self, later: "VisitEvidence") -> "VisitEvidence":
        """Return what both parts of a visit say if nothing had changed before the later one."""
        both = tuple(self.motions[0] + each for each in later.motions)
        return VisitEvidence(both, self.constant[0] + later.constant)

    def likelihoods(self, known: Motion) -> FloatArray:
        """Return how likely each share is with what is known of the motion, in nats."""
        values = []
        for own, constant in zip(self.motions, self.constant, strict=True):
            both = known + own
            factor, pulled = cho_factor(both.information), both.pulled
            log_det = 2 * float(np.log(np.diag(factor[0])).sum())
            values.append(constant + 0.5 * (float(pulled @ cho_solve(factor, pulled)) - log_det))
        return np.array(values)


def trusted(tile: LinearField, seen: Seen) -> Seen:
    """Return readings without spikes: without those that no field among the others explains."""
    weights = tile.robust_weights(seen.points, seen.field, seen.variance)
    field, _ = tile.field_and_gradient(seen.points, weights)
    squared = np.sum((seen.field - field) ** 2 / seen.variance, axis=1)
    return seen[np.asarray(squared <= SPIKE**2)]

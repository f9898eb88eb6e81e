r"""Visits of a tile that found another field there: steel was moved between two laps.

Readings of a visit differ from the field that earlier ones left for two reasons: the poses of the
visit are off, by one rigid motion as far as a tile is concerned, or the field has changed. Both are
asked of the same readings,

.. math::
    b = F w + D \xi + v \quad \text{or} \quad b = F (w + \delta) + D \xi + v

with w as earlier visits know it, xi the motion and delta a change as the prior of the waves has it,
but smaller: as large as makes the readings most likely.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.unknown_field.linear_field import LinearField

SHARES = (0.003, 0.01, 0.03, 0.1)  # of a change, over the prior of the waves
CLEAR = 10.0  # in nats: odds of 22,000 to 1 that the field changed
LIKELY = 0.5  # where something was moved on this drive, its field reaches other tiles, too
SPIKE = 6.0  # sigmas from the field of the others, beyond which a reading is none of the field
MOTION = np.repeat([np.deg2rad(5.0), 0.3], 3)  # standard deviations of xi, rad and metres
STEPS = 6  # of Gauss and Newton
HALVED = (1.0, 0.3, 0.1)  # of a step, where the whole one does not help


@dataclass(frozen=True)
class Seen:
    """Readings of a tile in the frame of its anchor.

    Attributes
    ----------
    points, field
        Where, metres, and what, uT, shapes (n, 3).
    variance
        Of each reading per axis, uT^2, shape (n, 3).
    """

    points: FloatArray
    field: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class _Fit:
    """What is left of a visit that was moved, with derivatives by the motion."""

    left: FloatArray
    D: FloatArray
    motion: FloatArray


def change_gain(tile: LinearField, earlier: Seen, visit: Seen) -> float:
    """Return how much likelier it is that a visit found another field than earlier ones, in nats.

    Parameters
    ----------
    tile
        Waves of the tile, of unit prior variance.
    earlier, visit
        Their readings.
    """
    earlier, visit = trusted(tile, earlier), trusted(tile, visit)
    F = tile.features(earlier.points).reshape(-1, len(tile))
    white = F / np.sqrt(earlier.variance).reshape(-1, 1)
    information = np.eye(len(tile)) + white.T @ white
    factor = cho_factor(information)
    pulled = white.T @ (earlier.field / np.sqrt(earlier.variance)).ravel()
    mean = cho_solve(factor, pulled)
    values = [likelihood(tile, mean, factor, visit, share) for share in (0.0, *SHARES)]
    return max(values[1:]) - values[0]


def trusted(tile: LinearField, seen: Seen) -> Seen:
    """Return readings without spikes: without those that no field among the others explains."""
    weights = tile.robust_weights(seen.points, seen.field, seen.variance)
    field, _ = tile.field_and_gradient(seen.points, weights)
    squared = np.sum((seen.field - field) ** 2 / seen.variance, axis=1)
    keep = squared <= SPIKE**2
    return Seen(seen.points[keep], seen.field[keep], seen.variance[keep])


def likelihood(
    tile: LinearField,
    mean: FloatArray,
    factor: tuple[FloatArray, bool],
    visit: Seen,
    share: float,
) -> float:
    """Return how likely a visit is with a change of this share, in nats, but for a constant.

    What field and change may be wrong by is that at the poses as they are believed.
    """
    F = tile.features(visit.points).reshape(-1, len(tile))
    S = F @ cho_solve(factor, F.T) + share**2 * (F @ F.T)
    S[np.diag_indices_from(S)] += visit.variance.ravel()
    noise, fit = cho_factor(S), fitted(tile, mean, visit, np.zeros(6))
    for _ in range(STEPS):
        pulled = cho_solve(noise, fit.D)
        information = fit.D.T @ pulled + np.diag(MOTION**-2)
        step = np.linalg.solve(information, pulled.T @ fit.left - fit.motion / MOTION**2)
        trials = [fitted(tile, mean, visit, fit.motion + scale * step) for scale in HALVED]
        best = min((fit, *trials), key=lambda each: _chi2(noise, each))
        if best is fit:
            break
        fit = best
    log_det = 2 * float(np.log(np.diag(noise[0])).sum())
    log_det += float(np.linalg.slogdet(information)[1])
    return -0.5 * (_chi2(noise, fit) + log_det)


def _chi2(noise: tuple[FloatArray, bool], fit: "_Fit") -> float:
    return float(fit.left @ cho_solve(noise, fit.left) + np.sum((fit.motion / MOTION) ** 2))


def fitted(tile: LinearField, mean: FloatArray, visit: Seen, motion: FloatArray) -> _Fit:
    """Return what is left of a visit moved by (rotation, translation) about its middle."""
    middle = visit.points.mean(axis=0)
    R = Rotation.from_rotvec(motion[:3]).as_matrix()
    arm = (visit.points - middle) @ R.T
    points, b = middle + arm + motion[3:], visit.field @ R.T
    field, gradient = tile.field_and_gradient(points, mean)
    D = np.empty((len(points), 3, 6))
    # A turned vehicle reads another field, and elsewhere: what is left changes by -D d(motion).
    D[:, :, :3] = skew(b) - gradient @ skew(arm)
    D[:, :, 3:] = gradient
    return _Fit((b - field).ravel(), D.reshape(-1, 6), motion)


def skew(v: FloatArray) -> FloatArray:
    """Return the matrices of the cross products with vectors, (n, 3): (n, 3, 3)."""
    return np.cross(v[:, None], np.eye(3)).transpose(0, 2, 1)

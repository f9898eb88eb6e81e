r"""Whether corrected poses are nearer to the truth than odometry's, before a truth is known.

Two figures, for poses X of K key poses that readings z have corrected from those of odometry, O:

1. **The evidence.** By how much the readings are likelier at X than at O, with the field integrated
   out and their noise the likeliest at each, less what X costs against odometry:
   ``log p(z | X) - log p(z | O) - c(X)``. With tiles the poses are integrated out, too
   (:func:`.kept_odometry.narrowing`).
2. **The doubt.** Readings fit poses that they have moved themselves better than others, by
   hundreds of nats even where these are further off: a path that is right in itself may be turned
   as a whole. How far is in the sigmas. With positions ``x = x_X + e``, e of covariance P
   after all measurements, and ``d = x_O - x_X``, those of odometry are nearer where
   ``|e - d|^2 < |e|^2``, with the probability

.. math::
    p(2 d \cdot e > d \cdot d) = \Phi(-z), \quad z = \frac{|d|^2}{2 \sqrt{d^T P d}}

A correction that is short beside its own sigmas along its direction shows nothing.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
from scipy.special import ndtr

from l2m_factors import X
from l2m_gtsam.data import BoolArray
from l2m_gtsam.records.localisation import Gain
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.marginals import PoseCovariance
from l2m_gtsam.slam.unknown_field.linear_field import AXES
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive

MOST_DOUBT = 0.05  # that odometry's poses are nearer
NOISE = np.geomspace(0.1, 10.0, 41)  # factors of the stated noise that are tried


def gain_of(
    poses: Sequence[gtsam.Pose3],
    odometry: Sequence[gtsam.Pose3],
    marginals: PoseCovariance,
    likelier: float,
) -> Gain:
    """Return what a correction of poses is worth.

    Parameters
    ----------
    poses, odometry
        K key poses, corrected and by odometry.
    marginals
        Of the corrected ones.
    likelier
        The evidence in nats.
    """
    d = np.stack([a.translation() - b.translation() for a, b in zip(odometry, poses, strict=True)])
    squared = float(np.sum(d**2))
    along = {
        X(k): np.append(np.zeros(3), pose.rotation().matrix().T @ own)
        for k, (pose, own) in enumerate(zip(poses, d, strict=True))
    }
    sigma = np.sqrt(marginals.variance_along(along)) if squared else 0.0
    doubt = float(ndtr(-0.5 * squared / sigma)) if sigma else 0.5
    moved = float(np.sqrt(squared / len(d)))
    return Gain(likelier, moved, doubt, shown=likelier > 0 and doubt <= MOST_DOUBT)


def readings_log_likelihood(tiled: TiledDrive, sensors: KnownSensors, used: BoolArray) -> float:
    """Return how likely readings are in tiles, their weights integrated out, but for constants.

    Parameters
    ----------
    tiled
        N readings in tiles at poses.
    sensors
        Calibrations.
    used
        Which readings count, shape (N,).
    """
    total = np.zeros(len(NOISE))
    for tile in tiled.tiles:
        own = np.flatnonzero(used[tile.rows])
        x, b = tile.placed.x[own], tile.placed.field(sensors)[own]
        variance = sensors.noise[tile.placed.readings.sensor[own], None] ** 2
        root = 1 / np.sqrt(variance + tile.field.unresolved(x))
        F = (tile.field.features(x) * root[:, :, None]).reshape(-1, len(tile.field))
        y = (b * root).ravel()
        # With F^T F = V diag(l) V^T, for each factor f of the noise
        # |y|^2 / f^2 - sum c^2 / (f^2 (f^2 + l)), and the determinant prod(1 + l / f^2).
        values, vectors = np.linalg.eigh(F.T @ F)
        values, c = np.maximum(values, 0.0), vectors.T @ (F.T @ y)
        f2 = NOISE[:, None] ** 2
        explained = np.sum(c**2 / (f2 * (f2 + values)), axis=1)
        total -= 0.5 * ((y @ y) / NOISE**2 - explained + np.log1p(values / f2).sum(axis=1))
        total += np.log(root).sum() - AXES * len(own) * np.log(NOISE)
    return float(total.max())

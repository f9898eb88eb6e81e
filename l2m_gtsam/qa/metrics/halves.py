"""Two calibrations of one sensor beside each other."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray
from l2m_gtsam.metric_results import Halves
from l2m_gtsam.qa.metrics.plain import row

TINY = 1e-12  # relative to the largest, of variances in units of useful sigmas
NOT_DONE = "halves of the drive were not calibrated by themselves (`qa.halves`)"


@dataclass(frozen=True)
class Half:
    """What one half of a drive says of a sensor: (t, C row by row, H), (15,), and its covariance.

    Variances of what it leaves open are infinite.
    """

    vector: FloatArray
    covariance: FloatArray


def no_halves(reason: str) -> Halves:
    """Return that there is no comparison, and why."""
    nothing = float("nan")
    return Halves((nothing,) * 15, (nothing,) * 15, nothing, 0, nothing, reason)


def compare_halves(first: Half, second: Half) -> Halves:
    """Return by how much two calibrations differ, in units and in sigmas.

    Errors that both share, of the same places of the map, count as if each had its own: the
    distance is too small rather than too large.
    """
    difference = second.vector - first.vector
    covariance = first.covariance + second.covariance
    known = np.isfinite(np.diag(covariance))
    sigma = np.sqrt(np.diag(covariance))
    if not known.any():
        return no_halves("the halves of the drive determine nothing of it by themselves")
    d, S = difference[known], covariance[np.ix_(known, known)]
    # In units of sigmas, so that metres and microtesla are alike; along principal axes.
    scale = sigma[known]
    values, axes = np.linalg.eigh(S / np.outer(scale, scale))
    sound = values > TINY * values[-1]
    along = (axes.T @ (d / scale))[sound] / np.sqrt(values[sound])
    return Halves(
        difference=row(difference),
        sigma=row(sigma),
        distance=float(np.sqrt(np.mean(along**2))),
        determined=int(sound.sum()),
        turned_deg=_turned(first.vector, second.vector),
    )


def _turned(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between the rotations in two calibrations in degrees."""
    polar = []
    for vector in (first, second):
        U, _, Vt = np.linalg.svd(Distortion.from_vector(vector[3:]).C)
        polar.append(U @ Vt)
    turn = polar[0].T @ polar[1]
    if np.linalg.det(turn) < 0:
        return float("nan")
    return float(np.rad2deg(Rotation.from_matrix(turn).magnitude()))

"""Two calibrations of one sensor on different readings beside each other."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, Distortion, FloatArray
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.metrics import Halves

TINY = 1e-12  # relative to the largest, of variances in units of useful sigmas
SEVERAL = "several drives are compared with each other instead of halves of one"
NOT_DONE = "halves of the drive were not calibrated by themselves (`qa.halves`)"


@dataclass(frozen=True)
class Part:
    """What a part of the readings says of a sensor.

    Attributes
    ----------
    vector
        (t, C row by row, H) in m and uT, shape (15,).
    covariance
        Its covariance, shape (15, 15); variances of what it leaves open are infinite.
    shared_root
        Two parts have ``root_a @ root_b.T`` of their covariances in common, shape (15, K); absent
        where that is not known.
    """

    vector: FloatArray
    covariance: FloatArray
    shared_root: FloatArray | None = None

    @property
    def known(self) -> BoolArray:
        """What it determines, shape (15,)."""
        return np.isfinite(np.diag(self.covariance))

    def shared(self, other: "Part") -> FloatArray:
        """Return the covariance with another part, shape (15, 15); zero where it is not known."""
        if self.shared_root is None or other.shared_root is None:
            return np.zeros_like(self.covariance)
        return np.asarray(self.shared_root @ other.shared_root.T)


def no_halves(reason: str) -> Halves:
    """Return that there is no comparison, and why."""
    nothing = float("nan")
    return Halves((nothing,) * 15, (nothing,) * 15, nothing, 0, nothing, reason)


def compare_halves(first: Part, second: Part) -> Halves:
    """Return by how much two calibrations differ, in units and in sigmas.

    Errors that both share, of the same places of the map, drop out as far as they are known to be
    shared. Else they count as if each had its own: the distance is then too small rather than too
    large.
    """
    difference = second.vector - first.vector
    covariance = first.covariance + second.covariance
    if first.shared_root is not None and second.shared_root is not None:
        covariance -= first.shared(second) + second.shared(first)
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

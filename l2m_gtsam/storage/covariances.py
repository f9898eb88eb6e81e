"""What messages say about the error of poses, and whether it can be believed."""

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, IntArray

SIZE = 36
# Asymmetry and negative eigenvalues that rounding explains, also in single precision, relative
# to the largest variance of positions and of rotations.
ROUNDING = 1e-6
# Drivers write large numbers for what they do not know, most often 1e3 to 1e6: nobody measures a
# map's field with poses that are worse than this, in metres and radians.
MOST_POSITION = 100.0
MOST_ROTATION = 1.0


@dataclass
class CovarianceBuffer:
    """Covariances of poses as they come; one that repeats the one before is kept once."""

    values: "array[float]" = field(default_factory=lambda: array("d", bytes(8 * SIZE)))
    row: "array[int]" = field(default_factory=lambda: array("q"))

    def add(self, covariance: Any) -> None:
        """Append the covariance of one pose: 36 numbers, or None where a type carries none."""
        if covariance is None:
            self.row.append(0)
            return
        numbers = np.asarray(covariance, dtype=np.float64).ravel()
        if len(numbers) != SIZE:
            numbers = np.full(SIZE, np.nan)
        new = numbers.tobytes()
        if new != self.values[-SIZE:].tobytes():
            self.values.frombytes(new)
        self.row.append(len(self.values) // SIZE - 1)

    def at(self, poses: IntArray) -> FloatArray | None:
        """Return the covariances of poses by their index, in ROS' order and axes.

        Returns
        -------
        Symmetric matrices, shape (N, 6, 6), or None unless every one of them is usable: where
        some errors are unknown, the others would be no measure of the whole.
        """
        matrices, rows = self._matrices(), np.array(self.row, dtype=np.int64)[poses]
        if not usable(matrices)[rows].all():
            return None
        return np.asarray(((matrices + matrices.swapaxes(1, 2)) / 2)[rows])

    def account(self) -> str:
        """Return what can be said of all covariances together, as half a sentence."""
        matrices, rows = self._matrices(), np.array(self.row, dtype=np.int64)
        if not matrices[np.unique(rows)].any():
            return "their covariance is unknown: all zero"
        wrong = int(np.sum(~usable(matrices)[rows]))
        if wrong:
            return f"their covariance is unknown: not usable in {wrong} of {len(rows)}"
        return "with covariance"

    def _matrices(self) -> FloatArray:
        """Return the distinct matrices, the first of them zero, shape (K, 6, 6)."""
        return np.array(self.values, dtype=np.float64).reshape(-1, 6, 6)


def usable(covariance: FloatArray) -> BoolArray:
    """Mark covariances that state an error: finite, not zero, not a placeholder, semidefinite.

    Parameters
    ----------
    covariance
        Matrices in ROS' order (x, y, z, rx, ry, rz), rad and m, shape (K, 6, 6).

    Returns
    -------
    Shape (K,).
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    most = np.array([MOST_POSITION, MOST_ROTATION])[:, None] ** 2
    plain = np.isfinite(covariance).all(axis=(1, 2)) & covariance.any(axis=(1, 2))
    plain &= (np.abs(variance) <= most).all(axis=(1, 2))
    good = np.flatnonzero(plain)
    largest = np.sqrt(np.abs(variance[good]).max(axis=2))
    scale = np.repeat(np.where(largest > 0, largest, 1.0), 3, axis=1)
    with np.errstate(over="ignore"):  # a huge covariance beside a tiny variance
        scaled = covariance[good] / scale[:, :, None] / scale[:, None, :]
    # Also keeps the eigenvalues from numbers that they cannot be found for.
    bounded = (np.abs(scaled) <= 1 + ROUNDING).all(axis=(1, 2))
    good, scaled = good[bounded], scaled[bounded]
    asymmetry = np.abs(scaled - scaled.swapaxes(1, 2)).max(axis=(1, 2))
    lowest = np.linalg.eigvalsh(scaled)[:, 0]
    found = np.zeros(len(covariance), dtype=np.bool_)
    found[good] = (asymmetry <= ROUNDING) & (lowest >= -ROUNDING)
    return found

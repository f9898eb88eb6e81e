"""What a peer says about a sensor, as far as it says it."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from l2m_gtsam.data import FloatArray


@dataclass(frozen=True)
class PeerEstimate:
    """The result of one calibration; NaN where a peer has no answer.

    Attributes
    ----------
    t
        Position of the sensor in the lidar frame in metres, shape (3,).
    C
        Distortion matrix, shape (3, 3).
    H
        Offset in microtesla, shape (3,).
    soft_iron
        ``soft_iron`` of C, shape (3, 3): all of C that a peer without a map can tell.
    seconds
        Time of this calibration alone, without what is done once for a site.
    """

    t: FloatArray
    C: FloatArray
    H: FloatArray
    soft_iron: FloatArray
    seconds: float

    @classmethod
    def nothing(cls, seconds: float) -> Self:
        """Return the estimate of a peer that ended without a result."""
        none = np.full((3, 3), np.nan)
        return cls(none[0], none, none[0], none, seconds)


def soft_iron(C: FloatArray) -> FloatArray:
    """Return what of C stays when the lidar is turned and the field's unit changed.

    That is the symmetric positive S of determinant one in ``C = s S Q``, with a number s and an
    orthogonal Q: the shape of the ellipsoid that readings of a constant field lie on.

    Parameters
    ----------
    C
        Regular, shape (3, 3).

    Returns
    -------
    Shape (3, 3).
    """
    U, s, _ = np.linalg.svd(C)
    return np.asarray((U * s) @ U.T / np.cbrt(np.prod(s)))

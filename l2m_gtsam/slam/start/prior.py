"""What is known of the start of a drive before readings are compared with a map."""

from dataclasses import dataclass

import numpy as np

from l2m_factors import skew
from l2m_gtsam.data import FloatArray, RigidTransform

UNKNOWN = np.repeat([10.0, 1e3], 3)  # rad and m: sigmas of what nothing is known of


@dataclass(frozen=True)
class Beforehand:
    """What is known before readings are looked at.

    Attributes
    ----------
    up
        The map's z axis in the frame of the first key pose, shape (3,).
    tilt
        Its standard deviation about each axis, rad.
    height, height_m
        Of the first key pose in the map, and its standard deviation, metres.
    spread
        Standard deviation per axis of the map's field from place to place, uT.
    largest
        Largest squared length of a whitened residual that passes for noise.
    """

    up: FloatArray
    tilt: float
    height: float
    height_m: float
    spread: float
    largest: float

    def said(self, at: RigidTransform) -> tuple[float, FloatArray, FloatArray]:
        """Return half the squared error in sigmas of a pose, with its derivatives (6,) and (6, 6).

        By a right perturbation, rotation before translation.
        """
        leans = at.R[2] - self.up
        rises = at.t[2] - self.height
        J = np.zeros((4, 6))
        J[:3, :3], J[3, 3:] = skew(at.R[2:])[0] / self.tilt, at.R[2] / self.height_m
        e = np.append(leans / self.tilt, rises / self.height_m)
        return float(0.5 * e @ e), J.T @ e, J.T @ J + np.diag(UNKNOWN**-2)

"""Prior knowledge as factors."""

import gtsam
import numpy as np

from l2m_factors.field_map import FloatArray
from l2m_factors.keys import D, T


def distortion_prior(sensor: int, C0: FloatArray, sigma: float) -> gtsam.CustomFactor:
    """Return the ridge of the closed form as a factor: C near ``C0``, H free.

    A ridge ``lambda ||C - C0||_F^2`` on whitened residuals is a prior with
    ``sigma = lambda ** -0.5`` on each entry of C.

    Parameters
    ----------
    sensor
        Index of the sensor.
    C0
        Expected distortion matrix, shape (3, 3).
    sigma
        Standard deviation of each entry of C.
    """
    expected = C0.ravel()
    derivative = np.eye(9, 12)

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is not None:
            jacobians[0] = derivative
        return np.asarray(values.atVector(D(sensor))[:9] - expected)

    return gtsam.CustomFactor(gtsam.noiseModel.Isotropic.Sigma(9, sigma), [D(sensor)], error)


def held_directions(sensor: int, directions: FloatArray, at: FloatArray) -> gtsam.CustomFactor:
    """Return a unit prior along directions which the data cannot determine.

    It holds them where they are as long as the readings say less than the prior.

    Parameters
    ----------
    sensor
        Index of the sensor.
    directions
        Rows over the 15-vector (t, C row by row, H), each scaled so that one is a step of one
        standard deviation, shape (K, 15).
    at
        The 15-vector at which they are held.
    """
    start = directions @ at

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        if jacobians is not None:
            jacobians[0] = directions[:, :3]
            jacobians[1] = directions[:, 3:]
        x = np.concatenate([values.atPoint3(T(sensor)), values.atVector(D(sensor))])
        return np.asarray(directions @ x - start)

    unit = gtsam.noiseModel.Unit.Create(len(directions))
    return gtsam.CustomFactor(unit, [T(sensor), D(sensor)], error)

"""Prior knowledge as factors."""

import gtsam
import numpy as np

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.keys import D, T

# What a small rotation by each axis adds to the identity, row by row, shape (9, 3).
TURNS = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(0, 2, 1).reshape(3, 9).T


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

    Raises
    ------
    ValueError
        C0 has another shape or a number that is not finite.
    """
    return _near(sensor, numbers("C0", C0, (3, 3)), gtsam.noiseModel.Isotropic.Sigma(9, sigma))


def rotation_prior(
    sensor: int, R_mag_lidar: FloatArray, turn_sigma: float, stretch_sigma: float
) -> gtsam.CustomFactor:
    """Return a nominal rotation as a factor: C near it, H free.

    C is taken for ``(I + E + [w]) R_mag_lidar``: a small rotation w of the mount and a stretch E
    of which all nine entries are independent.

    Parameters
    ----------
    sensor
        Index of the sensor.
    R_mag_lidar
        Nominal rotation from the lidar's to the sensor's axes, shape (3, 3).
    turn_sigma
        Standard deviation of each component of w in rad.
    stretch_sigma
        Standard deviation of each entry of E.

    Raises
    ------
    ValueError
        The rotation has another shape or a number that is not finite.
    """
    R = numbers("R_mag_lidar", R_mag_lidar, (3, 3))
    turned = np.kron(np.eye(3), R.T)  # C - R_mag_lidar from E + [w], row by row
    own = stretch_sigma**2 * np.eye(9) + turn_sigma**2 * TURNS @ TURNS.T
    noise = gtsam.noiseModel.Gaussian.Covariance(turned @ own @ turned.T)
    return _near(sensor, R, noise)


def distance_prior(first: int, second: int, metres: float, sigma: float) -> gtsam.CustomFactor:
    """Return a measured distance of two sensors as a factor on their positions.

    Unlike GTSAM's range factor it is finite where both are at one point: there no direction tells
    more than another, and none is taken.

    Parameters
    ----------
    first, second
        Indices of the sensors.
    metres, sigma
        The distance and its standard deviation.

    Raises
    ------
    ValueError
        Both are the same sensor.
    """
    if first == second:
        raise ValueError(f"second: {second} is the first, too; give two sensors")

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        apart = values.atPoint3(T(second)) - values.atPoint3(T(first))
        length = float(np.linalg.norm(apart))
        if jacobians is not None:
            along = (apart / max(length, np.finfo(float).tiny))[None]
            jacobians[0], jacobians[1] = -along, along
        return np.array([length - metres])

    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    return gtsam.CustomFactor(noise, [T(first), T(second)], error)


def _near(sensor: int, C0: FloatArray, noise: gtsam.noiseModel.Base) -> gtsam.CustomFactor:
    """Return a prior on C row by row."""
    expected = C0.ravel()
    derivative = np.eye(9, 12)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        if jacobians is not None:
            jacobians[0] = derivative
        return np.asarray(values.atVector(D(sensor))[:9] - expected)

    return gtsam.CustomFactor(noise, [D(sensor)], error)


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

    Raises
    ------
    ValueError
        An array has another shape or a number that is not finite.
    """
    directions = numbers("directions", directions, (len(directions), 15))
    start = directions @ numbers("at", at, (15,))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        if jacobians is not None:
            jacobians[0] = directions[:, :3]
            jacobians[1] = directions[:, 3:]
        x = np.concatenate([values.atPoint3(T(sensor)), values.atVector(D(sensor))])
        return np.asarray(directions @ x - start)

    unit = gtsam.noiseModel.Unit.Create(len(directions))
    return gtsam.CustomFactor(unit, [T(sensor), D(sensor)], error)

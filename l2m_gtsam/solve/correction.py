"""Readings corrected by a calibration, with the covariance of what comes out."""

import numpy as np

from l2m_gtsam.data import CorrectedField, Distortion, FloatArray


def corrected(
    readings: FloatArray, distortion: Distortion, covariance: FloatArray, variance: FloatArray
) -> CorrectedField:
    """Return ``b = inv(C) @ (z - H)`` and what noise and an inexact C and H make of it.

    From ``C b + H = z``: ``C db = dz - [kron(I, b^T), I] d(C, H)``. The error of C and H is common
    to all readings of a sensor: it does not average out.

    Parameters
    ----------
    readings
        z of one sensor in microtesla, shape (N, 3). One with a NaN axis is not known: every axis
        of the lidar may hold a part of it.
    distortion
        C without unit, shape (3, 3), and H in uT, shape (3,).
    covariance
        Of C row by row and H, in uT, shape (12, 12).
    variance
        Of the readings' own errors along the sensor's axes in uT^2, shape (N, 3).

    Returns
    -------
    CorrectedField
        Along the axes of the lidar.
    """
    known = np.isfinite(readings).all(axis=1)
    b = np.full(readings.shape, np.nan)
    spread = np.full((len(readings), 3, 3), np.nan)
    b[known] = distortion.undo(readings[known])
    J = _jacobian(b[known])
    # First-order propagation of errors: z = C b + H, of calibration and sensor noise, which are
    # independent.
    of_reading = J @ covariance @ J.transpose(0, 2, 1) + variance[known, :, None] * np.eye(3)
    # C^-1 S C^-T by two solves: no inverse is formed.
    half = np.linalg.solve(distortion.C, of_reading)
    found = np.linalg.solve(distortion.C, half.transpose(0, 2, 1))
    spread[known] = (found + found.transpose(0, 2, 1)) / 2
    return CorrectedField(b, spread)


def without_moving(readings: FloatArray, numbers: FloatArray, h: FloatArray) -> FloatArray:
    """Return readings without what follows K recorded numbers.

    Parameters
    ----------
    readings
        Of one sensor in microtesla, shape (N, 3).
    numbers
        At each reading, shape (N, K).
    h
        What they add, in uT per unit of each, shape (K, 3).
    """
    return np.asarray(readings - numbers @ h)


def moving_variance(numbers: FloatArray, h_sigma: FloatArray) -> FloatArray:
    """Return what the errors of h add to the variance of readings along each axis, uT^2, (N, 3).

    Parameters
    ----------
    numbers
        At each reading, shape (N, K).
    h_sigma
        Standard deviations of h in uT per unit, shape (K, 3); taken as independent of each other
        and of C and H.
    """
    return np.asarray(numbers**2 @ h_sigma**2)


def _jacobian(b: FloatArray) -> FloatArray:
    """Return the derivative of ``C b + H`` by C row by row and H, shape (N, 3, 12)."""
    J = np.zeros((len(b), 3, 12))
    for row in range(3):
        J[:, row, 3 * row : 3 * row + 3] = b
        J[:, row, 9 + row] = 1.0
    return J

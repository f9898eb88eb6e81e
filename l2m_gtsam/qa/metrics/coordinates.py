"""Coordinates of a change of a calibration, in terms of what happens to a sensor.

Moved, turned, scaled, skewed, magnetised, late: derivatives and the calibration after a change.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import expm, expm_frechet, polar

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.mounting import PAIRS
from l2m_gtsam.records.validation import CalibrationPart

PARAMETERS = 16  # t, C row by row, H, time offset
NO_CHANGE = np.zeros(PARAMETERS)
COLUMNS = {
    CalibrationPart.PLACE: slice(0, 3),
    CalibrationPart.ROTATION: slice(3, 6),
    CalibrationPart.GAINS: slice(6, 9),
    CalibrationPart.ANGLES: slice(9, 12),
    CalibrationPart.OFFSET: slice(12, 15),
    CalibrationPart.CLOCK: slice(15, 16),
}


def changes_of(C: FloatArray, change: FloatArray = NO_CHANGE) -> FloatArray:
    """Return what a change of each part does to (t, C row by row, H, time offset), (16, 16).

    Columns are those of ``COLUMNS``: metres; degrees by which the sensor turns about its own axes,
    R_lidar_mag to R_lidar_mag exp(d), so that field vectors turn by -d in it; relative gains;
    degrees by which the angles x y, y z, z x between axes become smaller; microtesla; seconds.

    Parameters
    ----------
    C
        As it was, shape (3, 3).
    change
        Coordinates about which these are derivatives, shape (16,).
    """
    basis = np.zeros((PARAMETERS, PARAMETERS))
    basis[:3, COLUMNS[CalibrationPart.PLACE]] = np.eye(3)
    basis[12:15, COLUMNS[CalibrationPart.OFFSET]] = np.eye(3)
    basis[15:, COLUMNS[CalibrationPart.CLOCK]] = 1.0
    R, own = polar(C, side="left")
    turn = change[COLUMNS[CalibrationPart.ROTATION]]
    stretched = stretch(change) @ own
    turned = own @ expm(-cross(turn)) @ R
    for k in range(3):
        d_turn = expm_frechet(-cross(turn), -cross(np.eye(3)[k]), compute_expm=False)
        column = COLUMNS[CalibrationPart.ROTATION].start + k
        basis[3:12, column] = (stretched @ d_turn @ R).ravel()
    for part in (CalibrationPart.GAINS, CalibrationPart.ANGLES):
        for column in range(COLUMNS[part].start, COLUMNS[part].stop):
            unit = np.zeros(PARAMETERS)
            unit[column] = 1.0
            basis[3:12, column] = ((stretch(unit) - np.eye(3)) @ turned).ravel()
    return basis


def changed_vector(vector: FloatArray, change: FloatArray) -> FloatArray:
    """Return (t, C row by row, H, time offset) after a change in these coordinates, (16,).

    A sensor that turns takes its own gains and angles along: with C = A R, A symmetric, it is
    ``(I + S) A exp(-d) R``, whose rows keep their lengths and angles under any turn d.
    """
    C = vector[3:12].reshape(3, 3)
    R, own = polar(C, side="left")
    turn = expm(-cross(change[COLUMNS[CalibrationPart.ROTATION]]))
    after = vector.copy()
    after[:3] += change[COLUMNS[CalibrationPart.PLACE]]
    after[3:12] = (stretch(change) @ own @ turn @ R).ravel()
    after[12:15] += change[COLUMNS[CalibrationPart.OFFSET]]
    after[15:] += change[COLUMNS[CalibrationPart.CLOCK]]
    return after


def cross(degrees: FloatArray) -> FloatArray:
    """Return the matrix of the cross product with a rotation vector in degrees, in radians."""
    x, y, z = np.deg2rad(degrees)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def stretch(change: FloatArray) -> FloatArray:
    """Return what changes of gains and angles do to the rows of C, shape (3, 3)."""
    S = np.eye(3) + np.diag(change[COLUMNS[CalibrationPart.GAINS]])
    for (i, j), angle in zip(PAIRS, change[COLUMNS[CalibrationPart.ANGLES]], strict=True):
        S[i, j] += np.deg2rad(angle) / 2
        S[j, i] += np.deg2rad(angle) / 2
    return S


def columns_of(parts: Sequence[CalibrationPart]) -> list[int]:
    """Return the columns of parts, in their order."""
    return [k for part in parts for k in range(COLUMNS[part].start, COLUMNS[part].stop)]


def width(part: CalibrationPart) -> int:
    """Return the number of coordinates of a part."""
    return COLUMNS[part].stop - COLUMNS[part].start

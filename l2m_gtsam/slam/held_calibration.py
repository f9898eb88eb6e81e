"""What a calibration that is held leaves out of the sigmas of poses, by its own covariance."""

import numpy as np

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import Drive, KnownSensors


def held_notes(drive: Drive) -> tuple[str, ...]:
    """Return which calibration errors are larger than noise, though they count as none."""
    errors = held_errors(drive.sensors, drive.readings)
    large = np.flatnonzero(errors > drive.sensors.noise)
    if not len(large):
        return ()
    names = [drive.sensors.names[k] for k in large]
    worst = large[np.argmax(errors[large] / drive.sensors.noise[large])]
    named = ", ".join(names[:5]) + (" and others" if len(names) > 5 else "")
    note = (
        f"the calibration is fixed, although its own sigmas put readings of {named} off by "
        f"{errors[worst]:.2g} uT (1 sigma), more than their noise of "
        f"{drive.sensors.noise[worst]:.2g} uT: poses may be off by far more than their sigmas; "
        "give `slam.calibration: refined`"
    )
    return (note,)


def held_errors(sensors: KnownSensors, readings: KeyPoseReadings) -> FloatArray:
    """Return how far C and H of each sensor let its readings be off, rms per axis in uT, (S,).

    That of the sensor's position is not counted; it would add to it.
    """
    return np.array([_error(sensors, readings, k) for k in range(len(sensors.names))])


def _error(sensors: KnownSensors, readings: KeyPoseReadings, index: int) -> float:
    measured = readings.field[readings.sensor == index]
    if not len(measured):
        return 0.0
    C, H = sensors.distortion[index, :9].reshape(3, 3), sensors.distortion[index, 9:]
    b = np.linalg.solve(C, (measured - H).T).T
    # An axis reads c b + h, c a row of C: its variance is w^T P w with w = (b, 1), and the mean of
    # it over the readings is that of the products of w with P.
    w = np.column_stack([b, np.ones(len(b))])
    mean = w.T @ w / len(w)
    covariance = sensors.covariance[index, 3:, 3:]
    rows = [np.array([3 * axis, 3 * axis + 1, 3 * axis + 2, 9 + axis]) for axis in range(3)]
    variance = [float((mean * covariance[np.ix_(row, row)]).sum()) for row in rows]
    return float(np.sqrt(max(float(np.mean(variance)), 0.0)))  # rounding may make it negative

"""Whether a calibration is held, and what that leaves out of sigmas, by its own covariance."""

import numpy as np

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions

# Errors of a calibration last, and noise averages out: of 0.15 of the noise per reading poses in a
# hall show nothing, of 0.45 they become half as wrong again.
UNSEEN = 0.1
FIELD_UT, SLOPE_UT_M = 50.0, 10.0  # of the Earth, and beside steel


def with_calibration_use(
    options: SlamOptions, sensors: KnownSensors, *, one_field: bool
) -> SlamOptions:
    """Return options in which `calibration` is `fixed` or `refined`.

    Parameters
    ----------
    options
        As they are given.
    sensors
        Whose calibration it is.
    one_field
        Whether there is a single sensor and nothing else that knows its places.
    """
    if options.calibration is not CalibrationUse.AUTO:
        return options
    is_exact = bool((expected_errors(sensors) < UNSEEN * sensors.noise).all())
    use = CalibrationUse.FIXED if one_field or is_exact else CalibrationUse.REFINED
    return options.model_copy(update={"calibration": use})


def expected_errors(sensors: KnownSensors) -> FloatArray:
    """Return how far t, C and H let readings be off in a field that is not known yet, uT, (S,).

    The field may have any direction: what cancels in the field of a drive does not here.
    """
    anywhere = FIELD_UT * np.eye(3)
    by_distortion = [_rms_error(anywhere, each[3:, 3:]) for each in sensors.covariance]
    by_place = SLOPE_UT_M * np.sqrt(np.einsum("sii->si", sensors.covariance[:, :3, :3]).max(axis=1))
    return np.asarray(np.hypot(by_distortion, by_place))


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
    return _rms_error(np.linalg.solve(C, (measured - H).T).T, sensors.covariance[index, 3:, 3:])


def _rms_error(b: FloatArray, covariance: FloatArray) -> float:
    """Return the rms per axis of what C and H let readings of fields b, (N, 3), be off by, uT."""
    # An axis reads c b + h, c a row of C: its variance is w^T P w with w = (b, 1), and the mean of
    # it over the readings is that of the products of w with P.
    w = np.column_stack([b, np.ones(len(b))])
    mean = w.T @ w / len(w)
    rows = [np.array([3 * axis, 3 * axis + 1, 3 * axis + 2, 9 + axis]) for axis in range(3)]
    variance = [float((mean * covariance[np.ix_(row, row)]).sum()) for row in rows]
    return float(np.sqrt(max(float(np.mean(variance)), 0.0)))  # rounding may make it negative

"""Rows of the fleet's table from a calibration and its verdict."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.judge import SensorVerdict, Verdict
from l2m_gtsam.qa.metrics.mounting import gains
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.qa.reasons.reason import Level, Reason, worst
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.fleet import SensorRow

NAN = float("nan")
DIGITS = 9  # well below any sigma, in metres as in microtesla


def sensor_rows(result: CalibrationResult, verdict: Verdict) -> tuple[SensorRow, ...]:
    """Return a row for every sensor of a calibration."""
    return tuple(_row(sensor, verdict[sensor.sensor], verdict.reasons) for sensor in result.sensors)


def _row(sensor: SensorCalibration, own: SensorVerdict, shared: tuple[Reason, ...]) -> SensorRow:
    reasons = tuple(sorted([*own.reasons, *shared], key=lambda each: -each.level.rank))
    level = worst(reasons)
    rotation_sigma = np.rad2deg(np.sqrt(np.diag(sensor.rotation_covariance)))
    figures, H = sensor.residuals, sensor.distortion.H
    return SensorRow(
        sensor=sensor.sensor,
        verdict=level.value,
        reason="" if level is Level.PASS else reasons[0].text,
        t=row(sensor.t_lidar_mag, DIGITS),
        t_sigma=row(sensor.t_sigma, DIGITS),
        quaternion_xyzw=row(_quaternion(sensor.R_lidar_mag), DIGITS),
        rotation_sigma=row(rotation_sigma, DIGITS),
        scale=row(gains(sensor.distortion.C), DIGITS),
        H=row(H, DIGITS),
        H_sigma=row(sensor.H_sigma, DIGITS),
        hard_iron=float(np.linalg.norm(H)),
        hard_iron_sigma=_length_sigma(H, sensor.covariance[12:, 12:]),
        residual_rms=NAN if figures is None else figures.rms,
        chi2=NAN if figures is None else figures.chi2_per_dof,
        rejected=_rejected(sensor),
    )


def _quaternion(R: FloatArray) -> FloatArray:
    """Return the quaternion xyzw with a positive w; NaN where there is no rotation."""
    if not np.isfinite(R).all():
        return np.full(4, NAN)
    return np.asarray(Rotation.from_matrix(R).as_quat(canonical=True))


def _length_sigma(H: FloatArray, covariance: FloatArray) -> float:
    """Return the standard deviation of the length of H, to first order."""
    length = float(np.linalg.norm(H))
    if not np.isfinite(np.diag(covariance)).all() or not np.isfinite(length):
        return float("inf")
    # A length that is zero has no direction: it is as unsure as the worst one.
    along = H @ covariance @ H / length**2 if length > 0 else np.diag(covariance).max()
    return float(np.sqrt(along))


def _rejected(sensor: SensorCalibration) -> float:
    used = 0 if sensor.residuals is None else sensor.residuals.readings
    inside = used + sensor.rejected
    return sensor.rejected / inside if inside else NAN

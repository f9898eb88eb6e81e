"""A calibration in words and numbers for people: what templates call."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.qa.report.figures.statistics import NAMES, correlations
from l2m_gtsam.qa.report.page import vector, with_sigma
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration, Uncertainty
from l2m_gtsam.records.metrics import Repeatability, Row, SensorMetrics
from l2m_gtsam.storage.calibration_file import UNCERTAINTY


def position(sensor: SensorCalibration) -> list[tuple[str, str]]:
    """Return the place of a sensor, coordinate by coordinate, in millimetres."""
    return [
        (f"{axis} (mm)", with_sigma(1e3 * value, 1e3 * sigma, 1))
        for axis, value, sigma in zip("xyz", sensor.t_lidar_mag, sensor.t_sigma, strict=True)
    ]


def rotation(sensor: SensorCalibration, metrics: SensorMetrics) -> str:
    """Return how a sensor is turned, as a sentence."""
    found = metrics.mounting
    if not np.isfinite(sensor.R_lidar_mag).all():
        return "Its rotation is not known: C is no rotation with scale, see the verdict."
    # intrinsic z, y, x: what ROS calls yaw, pitch, roll
    yaw, pitch, roll = Rotation.from_matrix(sensor.R_lidar_mag).as_euler("ZYX", degrees=True)
    known = np.isfinite(found.angle_sigma_deg)
    sigma = f" ± {found.angle_sigma_deg:.2f}°" if known else ", part of it not determined"
    text = (
        f"Turned by {found.angle_deg:.1f}°{sigma} about {vector(np.array(found.turned_about), 2)} "
        f"of the lidar; roll {roll:.1f}°, pitch {pitch:.1f}°, yaw {yaw:.1f}°."
    )
    axes = ", ".join(found.axes.along)
    return f"{text} Its axes x, y, z lie along the lidar's {axes}, to {found.axes.off_deg:.0f}°."


def distortion(sensor: SensorCalibration, metrics: SensorMetrics) -> list[str]:
    """Return gains, angles between axes and hard iron, a sentence each."""
    found = metrics.mounting
    gains = ", ".join(f"{axis} {gain:.3f}" for axis, gain in zip("xyz", found.scale, strict=True))
    pairs = ("x and y", "y and z", "z and x")
    angles = ", ".join(
        f"{pair} {90 - skew:.2f}°" for pair, skew in zip(pairs, found.skew_deg, strict=True)
    )
    H = vector(sensor.distortion.H, 2)
    worst = max(map(abs, found.skew_deg))
    return [
        f"Scale per axis (1 is ideal): {gains}.",
        f"Angles between its axes (90° is ideal): {angles}; {worst:.2f}° off at the most.",
        f"Hard iron: H = {H} µT, {found.hard_iron:.1f} µT long.",
    ]


def rests_on(metrics: SensorMetrics, result: CalibrationResult) -> list[str]:
    """Return what the sigmas of a sensor rest on, a sentence each."""
    fit = metrics.fit
    parts = f"sensor {fit.sensor_noise:.2f} µT, map {fit.map_noise:.2f} µT"
    if fit.pose_noise > 0:
        parts += f", poses {fit.pose_noise:.2f} µT"
    worth = metrics.autocorrelation.independent
    missing = next(each.missing_in for each in result.sensors if each.sensor == metrics.sensor)
    sentences = [f"Nothing usable was read of it in {', '.join(missing)}."] if missing else []
    sentences += [
        f"{fit.readings:,} readings (effective: {worth:,.0f}, as they are correlated in time).",
        f"Noise of each, per axis: {parts}.",
        f"How the map's errors count: {UNCERTAINTY[result.uncertainty]}.",
    ]
    if result.uncertainty is Uncertainty.INDEPENDENT:
        sentences.append("Sigmas of this kind are lower bounds.")
    return sentences


def drives(found: Repeatability) -> str:
    """Return how far drives are apart beside what chance allows, as a sentence without its end."""
    if not found.freedom:
        return "Too few drives determine the same parameters to compare them"
    ratio, low, high = (each / found.freedom for each in (found.squared, found.low, found.high))
    return (
        f"Normalised square of what they differ by, per degree of freedom: {ratio:.2f} (1 is "
        f"consistent, {low:.2f} to {high:.2f} in 95 % of cases)"
    )


def length(values: Row) -> float:
    """Return the length of a vector."""
    return float(np.linalg.norm(values))


def strongest(sensor: SensorCalibration) -> str:
    """Return the pair of parameters that depend on each other most."""
    lower = np.abs(np.tril(np.nan_to_num(correlations(sensor)), -1))
    i, j = np.unravel_index(int(np.argmax(lower)), lower.shape)
    return f"{NAMES[j]} and {NAMES[i]}, {correlations(sensor)[i, j]:+.2f}"

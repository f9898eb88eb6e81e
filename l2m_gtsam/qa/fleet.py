"""Drives of a fleet: rows of its table, parameters unlike those of other drives, history."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.qa.metrics.mounting import gains
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.fleet import FleetRow, Outlier, SensorRow
from l2m_gtsam.records.verdict import Level, Reason, SensorVerdict, Verdict

NAN = float("nan")
DIGITS = 9  # well below any sigma, in metres as in microtesla
MOST = 500  # rotations that are compared each with each: 2 MB
MEDIAN = np.pi / 2  # variance of a median beside that of a mean, of normal numbers
AGREE = 3  # drives that must agree at least: two of several always lie close to each other
CUT = 2.5  # standard deviations within which a value belongs to those that agree


def sensor_rows(result: CalibrationResult, verdict: Verdict) -> tuple[SensorRow, ...]:
    """Return a row for every sensor of a calibration."""
    return tuple(_row(sensor, verdict[sensor.sensor], verdict.reasons) for sensor in result.sensors)


def _row(sensor: SensorCalibration, own: SensorVerdict, shared: tuple[Reason, ...]) -> SensorRow:
    verdict = SensorVerdict.of(sensor.sensor, [*own.reasons, *shared])
    figures, H = sensor.residuals, sensor.distortion.H
    return SensorRow(
        sensor=sensor.sensor,
        verdict=verdict.level.value,
        reason="" if verdict.level is Level.PASS else verdict.reasons[0].text,
        t=row(sensor.t_lidar_mag, DIGITS),
        t_sigma=row(sensor.t_sigma, DIGITS),
        quaternion_xyzw=row(_quaternion(sensor.R_lidar_mag), DIGITS),
        rotation_sigma=row(sensor.turn_sigma_deg, DIGITS),
        scale=row(gains(sensor.distortion.C), DIGITS),
        H=row(H, DIGITS),
        H_sigma=row(sensor.H_sigma, DIGITS),
        hard_iron=float(np.linalg.norm(H)),
        hard_iron_sigma=_length_sigma(H, sensor.covariance[12:, 12:]),
        residual_rms=NAN if figures is None else figures.rms,
        chi2=NAN if figures is None else figures.chi2_per_dof,
        rejected=_rejected(sensor),
        own_verdict=own.level.value,
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
    return sensor.rejected / sensor.inside if sensor.inside else NAN


@dataclass(frozen=True)
class Parameter:
    """One parameter of a sensor over N drives.

    Attributes
    ----------
    name
        With its unit.
    value, sigma
        In that unit, shape (N,); not finite where a drive does not know it.
    least
        Deviations up to this are never marked.
    """

    name: str
    value: FloatArray
    sigma: FloatArray
    least: float


def with_outliers(rows: Sequence[FleetRow], options: FleetOptions) -> tuple[FleetRow, ...]:
    """Return rows with their outliers marked, each among those of its vehicle and sensor."""
    marked = list(rows)
    for places in by_sensor(rows).values():
        sensors = [each for k in places if (each := rows[k].sensor) is not None]
        found: list[list[Outlier]] = [[] for _ in places]
        for parameter in parameters(sensors, options):
            for k, outlier in _outliers(parameter, options).items():
                found[k].append(outlier)
        for k, outliers in zip(places, found, strict=True):
            worst_first = tuple(sorted(outliers, key=lambda each: -each.score))
            marked[k] = replace(marked[k], outliers=worst_first)
    return tuple(marked)


def by_sensor(rows: Sequence[FleetRow]) -> dict[tuple[str, str], list[int]]:
    """Return which rows belong to each vehicle and sensor, in order."""
    groups: dict[tuple[str, str], list[int]] = {}
    for k, each in enumerate(rows):
        if each.sensor is not None:
            groups.setdefault((each.vehicle, each.sensor.sensor), []).append(k)
    return groups


def parameters(sensors: Sequence[SensorRow], options: FleetOptions) -> list[Parameter]:
    """Return what is compared from drive to drive: position, rotation and H."""
    turned = rotations_apart(np.array([each.quaternion_xyzw for each in sensors]))
    t, t_sigma = (1e3 * _column(sensors, name) for name in ("t", "t_sigma"))
    H, H_sigma = (_column(sensors, name) for name in ("H", "H_sigma"))
    parts = (
        ("t", "mm", t, t_sigma, 1e3 * options.least_m),
        ("rotation", "deg", turned, _column(sensors, "rotation_sigma"), options.least_deg),
        ("H", "uT", H, H_sigma, options.least_ut),
    )
    return [
        Parameter(f"{name}_{axis} ({unit})", value[:, k], sigma[:, k], least)
        for name, unit, value, sigma, least in parts
        for k, axis in enumerate("xyz")
    ]


def rotations_apart(quaternions: FloatArray) -> FloatArray:
    """Return how rotations differ from the one that is nearest to all others.

    Of more than `MOST`, that one is sought among as many, evenly spread in their order.

    Parameters
    ----------
    quaternions
        R_lidar_mag as xyzw, NaN where there is none, shape (N, 4).

    Returns
    -------
    FloatArray
        Rotation vectors about the sensor's axes in degrees, shape (N, 3).
    """
    known = np.isfinite(quaternions).all(axis=1)
    apart = np.full((len(quaternions), 3), np.nan)
    if known.any():
        R = Rotation.from_quat(quaternions[known])
        apart[known] = np.rad2deg((_middle(R).inv() * R).as_rotvec())
    return apart


def _middle(R: Rotation) -> Rotation:
    """Return the one of N rotations that is nearest to all others, or to `MOST` of them."""
    count = min(len(R), MOST)
    among = R[np.arange(count) * len(R) // count]
    # Angles between all of them, from the cosines of half of each.
    q = among.as_quat()
    angles = 2 * np.arccos(np.clip(np.abs(q @ q.T), 0, 1))
    return among[int(np.argmin(angles.sum(axis=1)))]


def _column(sensors: Sequence[SensorRow], name: str) -> FloatArray:
    return np.array([getattr(each, name) for each in sensors], dtype=float).reshape(-1, 3)


def _outliers(parameter: Parameter, options: FleetOptions) -> dict[int, Outlier]:
    """Return the drives on which a parameter is beyond both its uncertainty and the spread."""
    known = np.flatnonzero(np.isfinite(parameter.value) & np.isfinite(parameter.sigma))
    if len(known) < options.drives:
        return {}
    value, sigma = parameter.value[known], parameter.sigma[known]
    usual = agreeing(value)
    d = value - np.median(value[usual])
    expected = expected_deviation(value, sigma, usual)
    beyond = (np.abs(d) > options.outlier * expected) & (np.abs(d) > parameter.least)
    return {
        int(known[k]): Outlier(parameter.name, float(d[k]), float(abs(d[k]) / expected[k]))
        for k in np.flatnonzero(beyond)
    }


def agreeing(value: FloatArray) -> BoolArray:
    """Return which of N values agree with each other, shape (N,): at least half of them.

    Those about the middle of the shortest interval that holds half of all. Values that are off
    together do not widen that interval as long as they are not the larger part: of a sensor that
    was displaced between drives, median and spread of all would lie between both places. Of two
    halves the closer one counts.

    Notes
    -----
    The least median of squares in one dimension, with its correction for few values, reweighted:
    Rousseeuw and Leroy, Robust Regression and Outlier Detection (1987), sections 4.4 and 5.1.
    """
    count = len(value)
    half = max((count + 1) // 2, min(AGREE, count))
    ordered = np.sort(value)
    width = ordered[half - 1 :] - ordered[: count - half + 1]
    first = int(np.argmin(width))
    middle = (ordered[first] + ordered[first + half - 1]) / 2
    scale = (1 + 5 / max(count - 1, 1)) * width[first] / 2 / ndtri(0.75)
    # Both ends of the interval belong to it, to rounding.
    inside = (value >= ordered[first]) & (value <= ordered[first + half - 1])
    return np.asarray(inside | (np.abs(value - middle) <= CUT * scale))


def expected_deviation(value: FloatArray, sigma: FloatArray, usual: BoolArray) -> FloatArray:
    """Return how far each of N values may well be from the median of the usual ones, shape (N,).

    The larger of the standard deviation of the difference, which holds where sigmas are true, and
    of the usual values' spread, which is what drives differ by for reasons that no sigma includes.
    """
    # Of N normal values the median has pi / 2 times the variance of the mean.
    of_median = MEDIAN * np.median(sigma[usual]) ** 2 / usual.sum()
    spread = float(np.std(value[usual], ddof=1))
    smallest = np.finfo(float).tiny  # values that are exact and all alike
    return np.asarray(np.maximum(np.sqrt(sigma**2 + of_median), max(spread, smallest)))


@dataclass(frozen=True)
class VerdictHistory:
    """The verdicts on the sensors of a vehicle, in order of time.

    Attributes
    ----------
    vehicle
        Its name.
    drives
        Names of bags with their dates, the oldest first.
    sensors
        Names, and a verdict for each drive; none where the drive was not calibrated, or has no such
        sensor.
    """

    vehicle: str
    drives: tuple[tuple[str, str], ...]
    sensors: tuple[tuple[str, tuple[str | None, ...]], ...]


def verdict_histories(rows: Sequence[FleetRow]) -> tuple[VerdictHistory, ...]:
    """Return the histories of all vehicles that have several drives, in the order of the rows."""
    found = [_history(name, rows) for name in dict.fromkeys(row.vehicle for row in rows)]
    return tuple(each for each in found if len(each.drives) > 1)


def _history(vehicle: str, rows: Sequence[FleetRow]) -> VerdictHistory:
    own = [row for row in rows if row.vehicle == vehicle]
    # Drives may have one name and, of clocks that were never set, one date: folders differ.
    drives = sorted({(row.date, row.bag, row.folder) for row in own})
    levels = {(each.sensor.sensor, each.folder): each.verdict for each in own if each.sensor}
    names = sorted({name for name, _ in levels})
    sensors = tuple(
        (name, tuple(levels.get((name, folder)) for _, _, folder in drives)) for name in names
    )
    return VerdictHistory(vehicle, tuple((bag, date) for date, bag, _ in drives), sensors)

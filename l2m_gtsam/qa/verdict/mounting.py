"""Rules on mounting: place, rotation, gains and hard iron beside nominal ones."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.reasons import failure, note, warning
from l2m_gtsam.qa.verdict.sensor import Case
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration, SensorStatus
from l2m_gtsam.records.metrics import AxisOrder
from l2m_gtsam.records.verdict import Reason

NOT_SOLVED = (SensorStatus.NO_READINGS, SensorStatus.OUTSIDE_MAP)


def mounting(case: Case) -> list[Reason]:
    """Return what is unusual about place, rotation, gains and hard iron."""
    if case.metrics is None:
        return []
    return [*_place(case), *_turn(case), *_gains(case), *_hard_iron(case)]


def _place(case: Case) -> list[Reason]:
    sensor, options = case.sensor, case.options
    if not np.isfinite(sensor.t_sigma).all():
        return []
    roughly = rough_place(sensor.sensor, case.result, options)
    if roughly is not None and (other := _swapped_with(case, roughly)):
        return failure(
            f"It is where {other} should be, and {other} is where it should be: the two are "
            "swapped. Exchange their topics or their cables."
        )
    meant = nominal_place(sensor.sensor, case.result, options)
    if meant is None:
        return []
    off = sensor.t_lidar_mag - meant
    if np.linalg.norm(off) < 3 * sensor.t_sigma.max():
        return []
    text = (
        f"It was found {1e3 * np.linalg.norm(off):.0f} mm from its nominal place, by "
        f"({', '.join(f'{1e3 * each:.0f}' for each in off)}) mm."
    )
    return options.nominal_m.reasons(float(np.linalg.norm(off)), text)


def _swapped_with(case: Case, meant: FloatArray) -> str | None:
    """Return the sensor with which this one has changed places, if it has."""
    for other in case.result.sensors:
        if other is case.sensor or other.status in NOT_SOLVED:
            continue
        there = rough_place(other.sensor, case.result, case.options)
        if there is None:
            continue
        # Each is nearer by far to the other's place than to its own.
        half = np.linalg.norm(there - meant) / 2
        near = _away(case.sensor, there) < half < _away(case.sensor, meant)
        if near and _away(other, meant) < half < _away(other, there):
            return other.sensor
    return None


def _away(sensor: SensorCalibration, place: FloatArray) -> float:
    return float(np.linalg.norm(sensor.t_lidar_mag - place))


def _turn(case: Case) -> list[Reason]:
    if case.metrics is None or not np.isfinite(case.sensor.R_lidar_mag).all():
        return []
    found, options = case.metrics.mounting, case.options
    along = (
        "its axes x, y, z lie along the lidar's " + ", ".join(found.axes.along)
        if found.axes.off_deg <= options.axes_deg
        else "its axes lie along none of the lidar's"
    )
    meant = nominal_rotation(case.sensor.sensor, case.result, options)
    if meant is not None:
        turn = Rotation.from_matrix(meant.T @ case.sensor.R_lidar_mag).magnitude()
        off = float(np.rad2deg(turn))
        text = f"It is turned by {off:.0f}° against its nominal rotation: {along}."
        return options.nominal_deg.reasons(off, text)
    if found.axes.usual or found.axes.off_deg > options.axes_deg or found.axes.mirrored:
        return []
    return _unexpected(case.sensor.sensor, found.axes, along)


def _unexpected(sensor: str, order: AxisOrder, along: str) -> list[Reason]:
    swapped = "exchanged" if any(a[1] != n for a, n in zip(order.along, "xyz", strict=True)) else ""
    what = f"Its axes are {swapped}" if swapped else "Two of its axes are reversed"
    return warning(
        f"{what}: {along}. Its driver mixes axes: `bag.axes: {{{sensor}: {order.in_order}}}` puts "
        "them in order. Or it is mounted like this: then state it in `qa.nominal`."
    )


def _gains(case: Case) -> list[Reason]:
    if case.metrics is None or case.sensor.status is SensorStatus.DEAD_AXIS:
        return []
    found, options = case.metrics.mounting, case.options
    known = np.isfinite(case.sensor.C_sigma)
    off = [abs(s - 1) if all(k) else 0.0 for s, k in zip(found.scale, known, strict=True)]
    axis = int(np.argmax(off))
    skew = max(map(abs, found.skew_deg)) if known.all() else 0.0
    text = f"Its {'xyz'[axis]} axis reads {found.scale[axis]:.2f} times the field."
    skewed = f"Two of its axes are {skew:.0f}° away from a right angle."
    return [*options.scale.reasons(off[axis], text), *options.skew_deg.reasons(skew, skewed)]


def _hard_iron(case: Case) -> list[Reason]:
    if case.metrics is None or not np.isfinite(case.sensor.H_sigma).all():
        return []
    strength = case.metrics.mounting.hard_iron
    if strength < case.options.hard_iron_ut:
        return []
    x, y, z = case.sensor.distortion.H
    return note(
        f"Strong hard iron: H = ({x:.1f}, {y:.1f}, {z:.1f}) µT, {strength:.0f} µT together, as "
        "of a magnet on the vehicle near the sensor. It is calibrated; keep the magnet where "
        "it is, or calibrate again."
    )


def check_names(sensors: Sequence[str], options: QaOptions) -> None:
    """Raise a ConfigError if ``qa.nominal`` names a sensor that is not there."""
    if unknown := sorted(set(options.nominal) - set(sensors)):
        msg = f"qa.nominal: no sensor named {unknown[0]!r}; there are {', '.join(sensors)}"
        raise ConfigError(msg)


def nominal_place(sensor: str, result: CalibrationResult, options: QaOptions) -> FloatArray | None:
    """Return the place where a sensor was meant to be in metres, shape (3,), if that is known."""
    given = options.nominal.get(sensor)
    if given is not None and given.t_lidar_mag is not None:
        return np.array(given.t_lidar_mag)
    measured = _of_sensor(_part(_part(_calibration(result), "priors"), "position"), sensor)
    if measured is None or set(measured) != {"x", "y", "z"}:
        return None
    return np.array([measured[axis][0] for axis in "xyz"], dtype=float)


def rough_place(sensor: str, result: CalibrationResult, options: QaOptions) -> FloatArray | None:
    """Return about where a sensor was meant to be in metres, shape (3,), if that is known.

    Where a solve starts is known to decimetres: enough to see that two sensors are swapped, not
    to judge a place by.
    """
    if (meant := nominal_place(sensor, result, options)) is not None:
        return meant
    start = _part(_calibration(result), "start").get(sensor)
    return None if start is None else np.array(start, dtype=float)


def nominal_rotation(
    sensor: str, result: CalibrationResult, options: QaOptions
) -> FloatArray | None:
    """Return R_lidar_mag as it was meant to be, shape (3, 3), if that is known."""
    given = options.nominal.get(sensor)
    if given is not None and given.quaternion_xyzw is not None:
        return np.asarray(Rotation.from_quat(given.quaternion_xyzw).as_matrix())
    prior = _of_sensor(_part(_part(_calibration(result), "priors"), "rotation"), sensor)
    if prior is None:
        return None
    return np.asarray(Rotation.from_quat(prior["quaternion_xyzw"]).as_matrix())


def _calibration(result: CalibrationResult) -> dict[str, Any]:
    """Return the options of the calibration: those of the program hold them as a part."""
    return _part(result.options, "calibration") or result.options


def _part(options: dict[str, Any], name: str) -> dict[str, Any]:
    part = options.get(name)
    return part if isinstance(part, dict) else {}


def _of_sensor(known: dict[str, Any], sensor: str) -> Any:
    """Return what is known of a sensor by the first name or pattern that fits it."""
    return next((each for name, each in known.items() if fnmatchcase(sensor, name)), None)

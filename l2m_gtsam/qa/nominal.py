"""How sensors were meant to be mounted, from wherever the configuration says it."""

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.records.calibration import CalibrationResult


def check_names(sensors: Sequence[str], options: QaOptions) -> None:
    """Raise a ConfigError if something is said of a sensor that is not there."""
    if unknown := sorted(set(options.nominal) - set(sensors)):
        msg = f"qa.nominal: no sensor named {unknown[0]!r}; there are {', '.join(sensors)}"
        raise ConfigError(msg)


def nominal_place(sensor: str, result: CalibrationResult, options: QaOptions) -> FloatArray | None:
    """Return the place where a sensor was meant to be in metres, shape (3,), if that is known."""
    told = options.nominal.get(sensor)
    if told is not None and told.t_lidar_mag is not None:
        return np.array(told.t_lidar_mag)
    given = _calibration(result)
    if (start := _part(given, "start").get(sensor)) is not None:
        return np.array(start, dtype=float)
    measured = _of_sensor(_part(_part(given, "priors"), "position"), sensor)
    if measured is None or set(measured) != {"x", "y", "z"}:
        return None
    return np.array([measured[axis][0] for axis in "xyz"], dtype=float)


def nominal_rotation(
    sensor: str, result: CalibrationResult, options: QaOptions
) -> FloatArray | None:
    """Return R_lidar_mag as it was meant to be, shape (3, 3), if that is known."""
    told = options.nominal.get(sensor)
    if told is not None and told.quaternion_xyzw is not None:
        return np.asarray(Rotation.from_quat(told.quaternion_xyzw).as_matrix())
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

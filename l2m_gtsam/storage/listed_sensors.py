"""Sensors as they are listed by hand, or as a calibration has them: for those who need either."""

from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray, SyncCounts
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.geometry import polar_rotation
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.storage.calibration_file import FORMAT, calibration_in
from l2m_gtsam.storage.known_sensors import ListedSensor, listed_sensors_in
from l2m_gtsam.storage.yaml_file import read_yaml

NO_SYNC = SyncCounts(0, 0, 0, 0, 0, 0, 0)


def read_sensors(path: Path) -> CalibrationResult:
    """Return the sensors of a `calibration.yaml`, or of a plain list with t, C and H of each.

    A list says how well each is known; where it does not, the defaults of `ListedSensor` count, and
    a note says so.

    Raises
    ------
    CalibrationError
        The file is missing or neither of both.
    """
    content = read_yaml(path, CalibrationError)
    if isinstance(content, dict) and content.get("format") == FORMAT:
        return calibration_in(path, content)
    listed = listed_sensors_in(path, content)
    return CalibrationResult(
        sensors=tuple(_calibration(path, name, each) for name, each in listed.items()),
        iterations=0,
        uncertainty=Uncertainty.INDEPENDENT,
        doubts=(),
        disagreements=(),
        bag=None,
        map=None,
        options={},
        versions={},
        notes=_assumptions(path, listed),
    )


def _assumptions(path: Path, listed: dict[str, ListedSensor]) -> tuple[str, ...]:
    """Return what a list does not say of its sensors, and what counts instead."""
    vague = [name for name, each in listed.items() if not each.has_sigmas]
    silent = [name for name, each in listed.items() if not each.has_noise]
    sigmas = (
        f"{path}: sigmas of {_named(vague)} are not given: 5 mm of t, 0.01 of C and 0.5 uT of H "
        "are assumed"
    )
    noise = (
        f"{path}: the noise of readings of {_named(silent)} is not given (`noise`, uT per axis): "
        "0.3 uT is assumed"
    )
    return (*([sigmas] if vague else []), *([noise] if silent else []))


def _named(sensors: list[str]) -> str:
    return ", ".join(sensors[:5]) + (" and others" if len(sensors) > 5 else "")


def _calibration(path: Path, name: str, listed: ListedSensor) -> SensorCalibration:
    """Return a listed sensor as a calibration, its errors independent of each other."""
    known = listed.known(name)
    covariance = np.diag(_variances(listed))
    try:
        turned = polar_rotation(known.distortion.C, covariance[3:12, 3:12])
    except CalibrationError as error:
        raise CalibrationError(f"{path}: sensors.{name}: {error}") from error
    return SensorCalibration(
        sensor=name,
        status=SensorStatus.SOLVED,
        message="known beforehand",
        t_lidar_mag=known.t_lidar_mag,
        distortion=known.distortion,
        R_lidar_mag=turned.R_mag_lidar.T,
        covariance=covariance,
        rotation_covariance=turned.covariance,
        noise=listed.noise,
        residuals=None,
        undetermined=(),
        sync=NO_SYNC,
        outside_map=0,
        time_offset=listed.offset(),
    )


def _variances(listed: ListedSensor) -> FloatArray:
    """Return variances of t, C row by row and H, shape (15,)."""
    sigmas = [listed.t_sigma] * 3 + [listed.C_sigma] * 9 + [listed.H_sigma] * 3
    return np.square(sigmas)

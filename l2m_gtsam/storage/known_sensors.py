"""Files of sensors whose place and distortion are known: truths, mapping suites, calibrations."""

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field, field_validator

from l2m_gtsam.data import Distortion, KnownSensor
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.storage.yaml_file import Lenient, Matrix, Vector, read_model, write_yaml


class _Clock(Lenient):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    seconds: float = Field(default=0.0, ge=-10, le=10)


class _Known(Lenient):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    t_lidar_mag: Vector
    C: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    H: Vector = (0.0, 0.0, 0.0)
    time_offset: _Clock | None = None

    @field_validator("C")
    @classmethod
    def _invertible(cls, C: Matrix) -> Matrix:
        if np.linalg.cond(np.array(C)) > 1e6:  # gains a million apart are no magnetometer's
            raise ValueError("C cannot be inverted, so that its readings say nothing of the field")
        return C


class _KnownFile(Lenient):
    sensors: dict[str, _Known] = Field(min_length=1)

    @field_validator("sensors", mode="before")
    @classmethod
    def _known_ones(cls, sensors: Any) -> Any:
        """Leave out what a calibration could not solve: it is not known."""
        if not isinstance(sensors, dict):
            return sensors
        solved = SensorStatus.SOLVED.value
        return {
            name: entry
            for name, entry in sensors.items()
            if not isinstance(entry, dict) or entry.get("status", solved) == solved
        }


def write_known_sensors(
    path: Path, sensors: tuple[KnownSensor, ...], facts: dict[str, Any], header: str
) -> None:
    """Write sensors whose place and distortion are known: a truth or a mapping suite.

    Parameters
    ----------
    path
        File to write.
    sensors
        The sensors.
    facts
        Plain values that stand above them (seed, options).
    header
        Comment on top.
    """
    entries = {
        sensor.sensor: {
            "t_lidar_mag": sensor.t_lidar_mag.tolist(),
            "C": sensor.distortion.C.tolist(),
            "H": sensor.distortion.H.tolist(),
            **({"time_offset": {"seconds": sensor.time_offset}} if sensor.time_offset else {}),
        }
        for sensor in sensors
    }
    write_yaml(path, {**facts, "sensors": entries}, header)


def read_known_sensors(path: Path) -> dict[str, KnownSensor]:
    """Return the sensors of a truth, of a mapping suite or of a calibration, by name.

    Without C and H an entry is free of distortion: C = I, H = 0; without a time offset its clock is
    that of the poses. Sensors that a calibration could not solve are left out.

    Raises
    ------
    CalibrationError
        The file is missing or is not of this form.
    """
    return {
        name: _known(name, entry) for name, entry in read_model(path, _KnownFile).sensors.items()
    }


def _known(name: str, entry: _Known) -> KnownSensor:
    distortion = Distortion(np.array(entry.C), np.array(entry.H))
    seconds = 0.0 if entry.time_offset is None else entry.time_offset.seconds
    return KnownSensor(name, np.array(entry.t_lidar_mag), distortion, seconds)

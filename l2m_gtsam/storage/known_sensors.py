"""Files of sensors whose place and distortion are known: truths, mapping suites, calibrations."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_validator, model_validator

from l2m_gtsam.data import Distortion, KnownSensor, Matrix, Vector
from l2m_gtsam.errors import CalibrationError, Notice
from l2m_gtsam.records.calibration import SensorStatus, TimeOffset
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.known_errors import StatedErrors
from l2m_gtsam.storage.yaml_file import checked, read_yaml, write_yaml


class _Finite(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _Clock(_Finite):
    seconds: float = Field(default=0.0, ge=-10, le=10)


class _Known(_Finite):
    t_lidar_mag: Vector
    C: Matrix = Field(default_factory=lambda: np.eye(3))
    H: Vector = Field(default_factory=lambda: np.zeros(3))
    time_offset: _Clock | None = None

    @field_validator("C")
    @classmethod
    def _invertible(cls, C: Matrix) -> Matrix:
        if np.linalg.cond(C) > 1e6:  # gains a million apart are no magnetometer's
            raise ValueError("C cannot be inverted, so that its readings say nothing of the field")
        return C


class _Stated(_Known):
    """A sensor with what a file says of its errors."""

    errors: StatedErrors = StatedErrors()

    @model_validator(mode="before")
    @classmethod
    def _with_errors(cls, entry: Any) -> Any:
        return {**entry, "errors": entry} if isinstance(entry, dict) else entry

    @model_validator(mode="after")
    def _credible(self) -> Self:
        self.errors.in_common()
        self.errors.known()
        return self


class _Judged(_Finite):
    level: Level


class ListedSensor(_Known):
    """A sensor as it is listed by hand, with how well it is known."""

    t_sigma: float = Field(default=0.005, gt=0)
    """Standard deviation of each coordinate of its place, metres."""
    C_sigma: float = Field(default=0.01, gt=0)
    """Of each entry of C."""
    H_sigma: float = Field(default=0.5, gt=0)
    """Of each component of H, microtesla."""
    noise: float = Field(default=0.3, gt=0)
    """Of a reading, microtesla."""

    @property
    def has_sigmas(self) -> bool:
        """Whether the list says how well it is known."""
        return {"t_sigma", "C_sigma", "H_sigma"} <= self.model_fields_set

    def known(self, name: str) -> KnownSensor:
        """Return it as a sensor with a name."""
        return _known(name, self)

    def offset(self) -> TimeOffset | None:
        """Return the offset of its clock, which counts as exact; None where there is none."""
        if self.time_offset is None:
            return None
        return TimeOffset(self.time_offset.seconds, float("inf"), np.zeros(15), "it is listed")


class _KnownFile(_Finite):
    sensors: dict[str, _Stated] = Field(min_length=1)
    verdict: _Judged | None = None

    @field_validator("sensors", mode="before")
    @classmethod
    def _known_ones(cls, sensors: Any) -> Any:
        """Leave out what a calibration could not solve: it is not known."""
        if not isinstance(sensors, dict):
            return sensors
        solved = SensorStatus.SOLVED.value
        known = {
            name: entry
            for name, entry in sensors.items()
            if not isinstance(entry, dict) or entry.get("status", solved) == solved
        }
        if sensors and not known:
            raise ValueError("none of them is solved; the `message` of each says why")
        return known


class _ListedFile(_Finite):
    sensors: dict[str, ListedSensor] = Field(min_length=1)


_FILE = TypeAdapter(_KnownFile)
_LIST = TypeAdapter(_ListedFile)


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
        Plain values above them (seed, options).
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
    that of the poses; without covariance and sigmas its values count as exact. Sensors that a
    calibration could not solve are left out. A `Notice` says that
    a calibration was judged FAIL.

    Raises
    ------
    CalibrationError
        The file is missing or is not of this form.
    """
    found = checked(path, read_yaml(path, CalibrationError), _FILE)
    if found.verdict is not None and found.verdict.level is Level.FAIL:
        warnings.warn(f"{path}: its verdict is FAIL; its sensors are used", Notice, stacklevel=2)
    return {
        name: replace(
            _known(name, entry),
            covariance=entry.errors.known(),
            common=entry.errors.in_common(),
        )
        for name, entry in found.sensors.items()
    }


def level_of(path: Path) -> Level | None:
    """Return the verdict on the sensors of a file, if it has one; errors as of the reader."""
    found = checked(path, read_yaml(path, CalibrationError), _FILE)
    return None if found.verdict is None else found.verdict.level


def listed_sensors_in(path: Path, content: Any) -> dict[str, ListedSensor]:
    """Return the sensors of a list by name, with how well they are known.

    Parameters
    ----------
    path
        Of the list.
    content
        Its plain content.

    Raises
    ------
    CalibrationError
        It is not of this form.
    """
    return dict(checked(path, content, _LIST).sensors)


def _known(name: str, entry: _Known) -> KnownSensor:
    seconds = 0.0 if entry.time_offset is None else entry.time_offset.seconds
    return KnownSensor(name, entry.t_lidar_mag, Distortion(entry.C, entry.H), seconds)

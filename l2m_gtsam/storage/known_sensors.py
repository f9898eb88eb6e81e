"""Files of sensors whose place and distortion are known, and how well they are known."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_validator, model_validator

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Matrix, Vector
from l2m_gtsam.errors import CalibrationError, Notice
from l2m_gtsam.records.calibration import SensorStatus, TimeOffset
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.report_id import checked_id
from l2m_gtsam.storage.yaml_file import checked, read_yaml, write_yaml

SIZE, TAU = 16, 15  # (t, C row by row, H, time offset); the last is the offset
SHAPES = {"t_sigma": (3,), "C_sigma": (3, 3), "H_sigma": (3,)}
ROUNDING = 1e-6  # of a variance, of numbers written with few digits
LARGEST_OFFSET_S = 10.0  # that a clock may be off by
FARTHEST_M = 100.0  # of a sensor from the lidar: beyond it, its place is written in millimetres
LIKE = 0.85  # of ``difflib``: two letters of seven that changed places
# What a calibration leaves open is anywhere within these sigmas: metres, 1, uT, seconds.
OPEN = np.repeat([1.0, 1.0, 100.0, 0.1], [3, 9, 3, 1])


def stated_covariance(stated: Mapping[str, Any]) -> FloatArray | None:
    """Return the covariance of (t, C row by row, H, time offset), (16, 16); none if not said.

    Parameters
    ----------
    stated
        What a file says of a sensor's errors; all of it may be absent.

    Raises
    ------
    ValueError
        A sigma is not positive, or the covariance is none.
    """
    clock = stated.get("time_offset") or {}
    if stated.get("covariance") is None:
        own = _of_sigmas(stated, clock)
    else:
        own = np.zeros((SIZE, SIZE))
        own[:TAU, :TAU] = _numbers("covariance", stated["covariance"], (TAU, TAU))
        own[TAU, TAU] = _variance_of(clock)
        cross = clock.get("cross_covariance")
        if cross is not None and own[TAU, TAU] > 0:
            own[:TAU, TAU] = _numbers("time_offset.cross_covariance", cross, (TAU,))
            own[TAU, :TAU] = own[:TAU, TAU]
    return None if own is None else _proper(own)


def common_root(stated: Mapping[str, Any], own: FloatArray | None) -> FloatArray | None:
    """Return the root of what is common with the file's other sensors, (16, r); none if not said.

    Parameters
    ----------
    stated
        As of ``stated_covariance``.
    own
        What that returns.

    Raises
    ------
    ValueError
        It is no part of the covariance.
    """
    if stated.get("common") is None:
        return None
    root = _numbers("common", stated["common"], None)
    if root.ndim != 2 or len(root) != SIZE or not np.isfinite(root).all():
        raise ValueError(f"common has shape {root.shape}; {SIZE} rows of numbers are needed")
    if own is None:
        raise ValueError("common is part of a covariance, which is missing")
    sigma = np.sqrt(np.diag(own))
    scale = np.where(sigma > 0, sigma, 1.0)
    if np.linalg.eigvalsh((own - root @ root.T) / np.outer(scale, scale)).min() < -ROUNDING:
        raise ValueError("common is larger than the covariance that it is part of")
    return root


def _of_sigmas(stated: Mapping[str, Any], clock: Mapping[str, Any]) -> FloatArray | None:
    """Return a diagonal covariance; what no sigma is given for counts as exact."""
    given = [stated.get(name) for name in SHAPES]
    if all(each is None for each in given) and clock.get("sigma") is None:
        return None
    sigmas = [
        np.zeros(shape) if each is None else _sigma(name, each, shape)
        for (name, shape), each in zip(SHAPES.items(), given, strict=True)
    ]
    variances = [np.square(each).ravel() for each in sigmas]
    return np.diag(np.append(np.concatenate(variances), _variance_of(clock)))


def _variance_of(clock: Mapping[str, Any]) -> float:
    """Return that of a time offset; one that was held, or has no sigma, counts as exact."""
    if clock.get("sigma") is None:
        return 0.0
    sigma = float(_numbers("time_offset.sigma", clock["sigma"], ()))
    if not sigma >= 0:
        raise ValueError(f"time_offset.sigma is {sigma:g}; a sigma is positive")
    return sigma**2 if np.isfinite(sigma) else 0.0


def _sigma(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return positive sigmas; one number stands for all of them."""
    try:
        sigmas = np.broadcast_to(_numbers(name, value, None), shape)
    except ValueError as error:
        shapes = " by ".join(str(length) for length in shape)
        raise ValueError(f"{name} is one number or {shapes} of them") from error
    if not (np.isfinite(sigmas) & (sigmas > 0)).all():
        raise ValueError(f"{name} is {value}; give positive numbers, or leave it out for exact")
    return sigmas


def _numbers(name: str, value: Any, shape: tuple[int, ...] | None) -> FloatArray:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is made of numbers") from None
    if shape is not None and numbers.shape != shape:
        raise ValueError(f"{name} has shape {numbers.shape}; {shape} is needed")
    return numbers


def _proper(covariance: FloatArray) -> FloatArray:
    """Return a covariance without infinities, after checks."""
    variance = np.diag(covariance)
    if np.isnan(covariance).any() or (variance < 0).any():
        raise ValueError("covariance has entries that are no numbers, or negative variances")
    left_open = np.isinf(variance)
    covariance = np.where(left_open | left_open[:, None], 0.0, covariance)
    covariance[left_open, left_open] = OPEN[left_open] ** 2
    sigma = np.sqrt(np.diag(covariance))
    scaled = covariance / np.outer(*(np.where(sigma > 0, sigma, 1.0),) * 2)
    if not np.isfinite(scaled).all() or np.abs(scaled - scaled.T).max() > ROUNDING:
        raise ValueError("covariance is not symmetric")
    if np.linalg.eigvalsh(scaled).min() < -ROUNDING:
        raise ValueError("covariance has a negative direction; give sigmas in its place")
    return np.asarray(0.5 * (covariance + covariance.T))


def checked_place(t: FloatArray) -> FloatArray:
    """Return the position of a sensor, metres; a ValueError if no vehicle is as large."""
    if (away := float(np.linalg.norm(t))) > FARTHEST_M:
        raise ValueError(f"the sensor is {away:g} m from the LiDAR; positions are in metres")
    return t


def checked_gains(C: FloatArray) -> FloatArray:
    """Return a distortion matrix; a ValueError if it cannot be inverted."""
    if np.linalg.cond(C) > 1e6:  # gains a million apart are no magnetometer's
        raise ValueError("C cannot be inverted, so that its readings say nothing of the field")
    return C


class _Finite(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _Clock(_Finite):
    seconds: float = Field(default=0.0, ge=-LARGEST_OFFSET_S, le=LARGEST_OFFSET_S)


class _Known(_Finite):
    t_lidar_mag: Vector
    C: Matrix = Field(default_factory=lambda: np.eye(3))
    H: Vector = Field(default_factory=lambda: np.zeros(3))
    time_offset: _Clock | None = None

    @model_validator(mode="before")
    @classmethod
    def _well_spelt(cls, entry: Any) -> Any:
        for key in map(str, entry) if isinstance(entry, dict) else ():
            meant = _meant(key)
            if meant is not None and meant not in entry:
                raise ValueError(f"unknown key {key}; is {meant} meant?")
        return entry

    @field_validator("t_lidar_mag")
    @classmethod
    def _near(cls, t: Vector) -> Vector:
        return checked_place(t)

    @field_validator("C")
    @classmethod
    def _invertible(cls, C: Matrix) -> Matrix:
        return checked_gains(C)

    def known(self, name: str) -> KnownSensor:
        """Return it as a sensor with a name."""
        seconds = 0.0 if self.time_offset is None else self.time_offset.seconds
        return KnownSensor(name, self.t_lidar_mag, Distortion(self.C, self.H), seconds)


class _Stated(_Known):
    """A sensor with what a file says of its errors."""

    errors: dict[Any, Any] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _with_errors(cls, entry: Any) -> Any:
        return {**entry, "errors": entry} if isinstance(entry, dict) else entry

    @model_validator(mode="after")
    def _credible(self) -> Self:
        self.known("")
        return self

    def known(self, name: str) -> KnownSensor:
        """Return it as a sensor with a name and with its errors."""
        own = stated_covariance(self.errors)
        common = common_root(self.errors, own)
        return replace(super().known(name), covariance=own, common=common)


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

    @property
    def has_noise(self) -> bool:
        """Whether the list says how large the noise of a reading is."""
        return "noise" in self.model_fields_set

    def offset(self) -> TimeOffset | None:
        """Return the offset of its clock, which counts as exact; None where there is none."""
        if self.time_offset is None:
            return None
        return TimeOffset(self.time_offset.seconds, float("inf"), np.zeros(15), "it is listed")


KEYS = sorted({*ListedSensor.model_fields, "covariance", "common"})  # that are read


def _meant(key: str) -> str | None:
    """Return the key that one is so like that it must be meant; None if it is none of these."""
    by_lower = {each.lower(): each for each in KEYS}
    near = get_close_matches(key.lower(), by_lower, 1, LIKE)
    return by_lower[near[0]] if near else None


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
        The file is missing, is not of this form, or was changed after it was written.
    """
    content = read_yaml(path, CalibrationError)
    found = checked(path, content, _FILE)
    checked_id(path, content, CalibrationError)
    if found.verdict is not None and found.verdict.level is Level.FAIL:
        warnings.warn(f"{path}: its verdict is FAIL; its sensors are used", Notice, stacklevel=2)
    return {name: entry.known(name) for name, entry in found.sensors.items()}


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

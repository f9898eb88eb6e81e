"""Arguments of another kind than is wanted: one line says which, what came, and what is wanted."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from l2m_gtsam.api.results import JudgedCalibration
from l2m_gtsam.config import fault_in
from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.errors import ConfigError, InputError
from l2m_gtsam.options import Options
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.text import shown, shown_value

Model = TypeVar("Model", bound=Options)


@dataclass(frozen=True)
class Kind:
    """What an argument has to be.

    Attributes
    ----------
    wanted
        In words.
    fits
        Whether a value is that.
    reader
        Function that reads it from a file; empty where a path is not mistaken for it.
    """

    wanted: str
    fits: Callable[[Any], bool]
    reader: str = ""


def _has(*names: str) -> Callable[[Any], bool]:
    return lambda value: (
        not isinstance(value, type) and all(callable(getattr(value, name, None)) for name in names)
    )


ASKED = _has("query", "field_and_gradient")
DRIVE = Kind(
    "a drive, made by `l2m_gtsam.read_bag` or `l2m_gtsam.drive`",
    lambda value: isinstance(value, Recording),
    "read_bag",
)
MAP = Kind("a map, made by `l2m_gtsam.build_map` or `l2m_gtsam.load_map`", ASKED, "load_map")
WHOLE_MAP = replace(MAP, fits=_has("query", "field_and_gradient", "to_state"))
CALIBRATION = Kind(
    "a calibration, made by `l2m_gtsam.calibrate` or `l2m_gtsam.read_calibration`",
    lambda value: isinstance(value, JudgedCalibration | CalibrationResult),
    "read_calibration",
)
SENSOR = Kind(
    "a sensor, made by `l2m_gtsam.known_sensor`", lambda value: isinstance(value, KnownSensor)
)
PATH = Kind("the path of a file", lambda value: isinstance(value, str | PathLike))
NAME = Kind("the name of a sensor", lambda value: isinstance(value, str) and bool(value))
SENSORS = "a suite: sensors made by `l2m_gtsam.known_sensor`, or a file of them"


def came(value: object) -> str:
    """Return what a value is, in few words."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, list | tuple | dict | set):
        name = type(value).__name__
        return f"a {name} of {len(value)}" if value else f"an empty {name}"
    if value is None or isinstance(value, str | bool | int | float):
        return shown_value(value)
    if ASKED(value):
        return f"a map ({type(value).__name__})"
    name = value.__name__ if isinstance(value, type) else type(value).__name__
    article = "an" if name[:1].upper() in "AEIOU" else "a"
    return f"the class {name}" if isinstance(value, type) else f"{article} {name}"


def refused(name: str, value: object, wanted: str, reader: str = "") -> InputError:
    """Return the error of an argument that is not what is wanted, or the path of such a thing."""
    if reader and PATH.fits(value):
        return InputError(f"{name}: {str(value)!r} is a path; `l2m_gtsam.{reader}` reads it")
    return InputError(f"{name}: {shown(came(value))} was given; needed is {wanted}")


def check(kind: Kind, **given: Any) -> None:
    """Raise an InputError for the first argument that is of another kind."""
    for name, value in given.items():
        if not kind.fits(value):
            raise refused(name, value, kind.wanted, kind.reader)


def drives_of(name: str, value: Recording | Sequence[Recording]) -> list[Recording]:
    """Return one drive, or several, as a list.

    Raises
    ------
    InputError
        There is none, or something else among them.
    """
    return _all_of(DRIVE, f"{DRIVE.wanted}, or a list of them", name, value)


def sensors_of(
    value: KnownSensor | Mapping[str, KnownSensor] | Iterable[KnownSensor],
) -> Mapping[str, KnownSensor]:
    """Return the sensors of a suite by name.

    Raises
    ------
    InputError
        It is something else, or a name is listed twice.
    """
    if isinstance(value, Mapping):
        for name, sensor in value.items():
            check(NAME, **{"suite: a name": name})
            check(SENSOR, **{f"suite[{name!r}]": sensor})
        return value
    found: dict[str, KnownSensor] = {}
    for each in _all_of(SENSOR, SENSORS, "suite", value):
        if each.sensor in found:
            raise InputError(f"suite: {each.sensor!r} is listed twice; list each sensor once")
        found[each.sensor] = each
    return found


def path_of(name: str, value: Any) -> Path:
    """Return a path; an InputError for what is none."""
    check(PATH, **{name: value})
    return Path(fspath(value))


def paths_of(name: str, value: Any) -> list[Path]:
    """Return one path, or several, as a list; an InputError for what is none."""
    wanted = f"{PATH.wanted}, or a list of them"
    return [Path(fspath(each)) for each in _all_of(PATH, wanted, name, value)]


def pair_of(name: str, value: Any) -> tuple[Any, Any]:
    """Return the stamps and the readings of a sensor; an InputError for anything but two values."""
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise refused(name, value, "(stamps, readings)")
    return value[0], value[1]


def options_of(model: type[Model], given: Model | Mapping[str, Any] | None, name: str) -> Model:
    """Return options, defaults where none are given; a ConfigError names the first fault."""
    if isinstance(given, model):
        return given
    try:
        return model.model_validate({} if given is None else given)
    except ValidationError as error:
        raise ConfigError(fault_in(model, error, name)) from error


def _all_of(kind: Kind, wanted: str, name: str, value: Any) -> list[Any]:
    """Return one value of a kind, or several, as a list."""
    if kind.fits(value):
        return [value]
    several = isinstance(value, Iterable) and not isinstance(value, str | Mapping | np.ndarray)
    listed = list(value) if several and not ASKED(value) else []
    if not listed:
        raise refused(name, value, wanted, kind.reader)
    for index, each in enumerate(listed):
        check(kind, **{f"{name}[{index}]": each})
    return listed

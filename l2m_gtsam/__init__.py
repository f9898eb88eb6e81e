"""Calibrate magnetometers against a LiDAR from one drive through a mapped magnetic field.

The names below are loaded when they are first used, so that importing the package takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from l2m_gtsam.api.arrays import drive, known_sensor
    from l2m_gtsam.api.calls import build_map, calibrate, keep_map_up, localise
    from l2m_gtsam.api.files import load_map, read_bag, read_calibration, read_suite, save_map

    __version__: str

__all__ = [
    "__version__",
    "build_map",
    "calibrate",
    "drive",
    "keep_map_up",
    "known_sensor",
    "load_map",
    "localise",
    "read_bag",
    "read_calibration",
    "read_suite",
    "save_map",
]

_NAMES = {
    "arrays": ("drive", "known_sensor"),
    "calls": ("build_map", "calibrate", "keep_map_up", "localise"),
    "files": ("load_map", "read_bag", "read_calibration", "read_suite", "save_map"),
}
_WHERE = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("l2m-gtsam")
    if name not in _WHERE:
        raise AttributeError(f"module 'l2m_gtsam' has no attribute {name!r}")
    return getattr(import_module(f"l2m_gtsam.api.{_WHERE[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])

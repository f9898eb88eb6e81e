"""The libraries that register scans, which are an extra."""

from importlib import import_module
from typing import Any

from l2m_gtsam.errors import LidarError


def library(name: str) -> Any:
    """Return a module of the extra.

    Raises
    ------
    LidarError
        It is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.split(".", maxsplit=1)[0]
        raise LidarError(
            f"poses from point clouds need {package}: pip install 'l2m_gtsam[lidar]'"
        ) from error

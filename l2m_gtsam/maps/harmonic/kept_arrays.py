"""Checks of arrays that were kept: a store may hand back anything."""

from typing import Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.tile_store import Arrays

Shape = tuple[int | None, ...]
"""None stands for any length."""


def floats(arrays: Arrays, name: str, shape: Shape) -> npt.NDArray[np.float64]:
    """Return an array of an entry if it has this shape.

    Raises
    ------
    MapError
        It is missing, of another type or of another shape.
    """
    return _checked(arrays, name, shape, np.dtype(np.float64))


def integers(arrays: Arrays, name: str, shape: Shape) -> npt.NDArray[np.int64]:
    """Return an array of whole numbers; see ``floats``."""
    return _checked(arrays, name, shape, np.dtype(np.int64))


def finite(arrays: Arrays, name: str, shape: Shape) -> npt.NDArray[np.float64]:
    """Return an array of finite numbers; see ``floats``."""
    found = floats(arrays, name, shape)
    if not np.isfinite(found).all():
        raise MapError(f"{name} is not finite")
    return found


def _checked(arrays: Arrays, name: str, shape: Shape, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    found = arrays.get(name)
    if found is None or found.dtype != dtype or len(found.shape) != len(shape):
        raise MapError(f"{name} is missing or of another type")
    if any(asked not in (None, length) for asked, length in zip(shape, found.shape, strict=True)):
        raise MapError(f"{name} has shape {found.shape}")
    return found

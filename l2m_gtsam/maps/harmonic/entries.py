"""What tiles are kept as: a name, and all that they follow from as one number."""

import hashlib
import json
from functools import cache
from importlib.metadata import version
from typing import Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.places import Places
from l2m_gtsam.maps.tile_store import Arrays, Entry

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


ALGORITHM = 4
"""To be raised with every change to what is solved, compiled or kept of the same readings."""


def solved_entry(learnt: Learnt, index: int) -> Entry:
    """Return what a solved tile is kept as: it follows from readings, sources, prior and box."""
    rows = learnt.members[index]
    readings, history = learnt.readings[rows], learnt.history
    structures, strengths = learnt.structures(index)
    facts: dict[str, object] = {
        "algorithm": ALGORITHM,
        "versions": _versions(),
        "hyperparameters": learnt.hyperparameters.model_dump(mode="json"),
        "local": learnt.local.model_dump(mode="json"),
        "resolution": [learnt.resolution.floor, learnt.resolution.ceiling],
        "edge": learnt.tiling.edge,
        "sources": [len(each) for each in structures],
    }
    if history is not None:
        facts["drives"] = history.drive[rows].tolist()
        steps = history.steps_of(learnt.tiling.grid.cells[index])
        facts["steps"] = [[each.share, each.depth] for each in steps]
        near = learnt.structure_numbers(index)
        facts["freed"] = [history.freed_before(k, near) for k in range(history.drives)]
    fingerprint = _digest(
        facts,
        learnt.tiling.grid.centres[index],
        readings.points,
        readings.field,
        readings.weight,
        strengths,
        *(each.positions for each in structures),
        *_of_poses(learnt, index),
    )
    return Entry(f"{_cell(learnt, index)}.solved", fingerprint)


def _of_poses(learnt: Learnt, index: int) -> list[FloatArray]:
    """Return what a tile hangs on of the errors of poses; nothing if they count as exact."""
    poses, rows = learnt.poses, learnt.members[index]
    if poses is None:
        return []
    mine = np.flatnonzero(np.isin(poses.reading, rows))
    at = np.searchsorted(rows, poses.reading[mine])
    when = np.column_stack([at, poses.drive[mine], poses.seconds[mine]])
    sizes = np.ones(6) if poses.sizes is None else poses.sizes
    return [np.array([poses.lasting_s]), sizes, when, poses.shift[mine]]


def compiled_entry(learnt: Learnt, index: int, solved: Entry, places: Places) -> Entry:
    """Return what a compiled tile is kept as: it follows from the solved one and its places."""
    facts: dict[str, object] = {
        "solved": solved.fingerprint,
        "reach": places.reach,
        "half": places.half,
    }
    fingerprint = _digest(facts, places.centre, places.readings)
    return Entry(f"{_cell(learnt, index)}.compiled", fingerprint)


def _cell(learnt: Learnt, index: int) -> str:
    """Return the place of a tile among the others: a map that grows keeps it."""
    i, j = learnt.tiling.grid.cells[index].tolist()
    return f"{i}_{j}"


def _digest(facts: dict[str, object], *arrays: FloatArray) -> str:
    shapes = [array.shape for array in arrays]
    digest = hashlib.sha256(json.dumps([facts, shapes], sort_keys=True).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array, dtype="<f8").data)
    return digest.hexdigest()


@cache
def _versions() -> list[str]:
    """Return the versions of what computes: others may round otherwise."""
    return [version(name) for name in ("l2m-gtsam", "numpy", "scipy", "numba")]

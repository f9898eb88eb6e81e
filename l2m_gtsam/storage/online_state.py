"""Saved states of localisations on line: arrays and plain values, in the container of map files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import MapState
from l2m_gtsam.errors import ConfigError, MapError
from l2m_gtsam.storage.map_file import load_map, save_map

KIND = "online-state"
VERSION = 1


@dataclass(frozen=True)
class SavedState:
    """A state.

    Attributes
    ----------
    arrays
        Numeric arrays by name.
    facts
        Plain values.
    """

    arrays: dict[str, npt.NDArray[Any]]
    facts: dict[str, Any]


def write_state(path: Path, state: SavedState) -> None:
    """Write a state under a temporary name and rename it.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    arrays = {name: np.asarray(array) for name, array in state.arrays.items()}
    save_map(path, MapState(KIND, arrays, state.facts, {"version": VERSION}))


def read_state(path: Path) -> SavedState:
    """Return a state.

    Raises
    ------
    ConfigError
        There is no such file, it is something else, or it is damaged.
    """
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; begin without --resume")
    try:
        found = load_map(path)
    except MapError as error:
        raise ConfigError(damaged(path)) from error
    if found.kind != KIND or found.provenance != {"version": VERSION}:
        raise ConfigError(damaged(path))
    return SavedState(found.arrays, found.options)


def damaged(path: Path) -> str:
    """Return that a file is no state."""
    return (
        f"{path}: not a state that this version of `l2m slam --online` saved, or damaged; begin "
        "without --resume"
    )

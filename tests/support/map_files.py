"""Map files for tests that need a copy of their own."""

import json
import os
import shutil
from pathlib import Path

from l2m_gtsam.data import MapState
from l2m_gtsam.storage.tile_folder import SUFFIX


def copy_map(source: Path, target: Path) -> Path:
    """Copy a map with the tiles beside it, so that none is solved again, and return the copy.

    Tiles are links: a store never writes into a file, it puts a new one in its place.
    """
    shutil.copy(source, target)
    tiles = source.with_suffix(SUFFIX)
    if tiles.is_dir():
        shutil.copytree(tiles, target.with_suffix(SUFFIX), copy_function=os.link)
    return target


def through_a_file(state: MapState) -> MapState:
    """What is left of a state when options and provenance went through JSON."""
    options, provenance = json.loads(json.dumps([state.options, state.provenance]))
    return MapState(state.kind, state.arrays, options, provenance)

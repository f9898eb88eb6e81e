"""Map files: ``.npz`` without pickle, versioned, with a checksum over everything."""

import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.atomic import atomic_path

FORMAT = "l2m-map"
VERSION = 1
HEADER, CHECKSUM = "header", "checksum"
# A warehouse with everything is under 100 MB; a file that unpacks to more is not ours.
MAX_BYTES = 2 << 30


def save_map(path: Path, state: MapState) -> None:
    """Write a map; the same state gives the same bytes.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    header = {
        "format": FORMAT,
        "version": VERSION,
        "kind": state.kind,
        "options": state.options,
        "provenance": state.provenance,
    }
    text = json.dumps(header, sort_keys=True).encode()
    arrays = {
        HEADER: np.frombuffer(text, dtype=np.uint8),
        CHECKSUM: np.frombuffer(_checksum(text, state.arrays), dtype=np.uint8),
        **{f"array/{name}": array for name, array in sorted(state.arrays.items())},
    }
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load_map(path: Path) -> MapState:
    """Return the map in a file.

    Raises
    ------
    MapError
        No such file, not a map, damaged, or of a newer version.
    """
    if not path.is_file():
        raise MapError(f"{path}: no such map file; make one with `l2m map build`")
    try:
        contents = _read_arrays(path)
        text = contents.pop(HEADER).tobytes()
        stated = contents.pop(CHECKSUM).tobytes()
        header = json.loads(text)
        recognised = header["format"] == FORMAT
    except MapError:
        raise
    except Exception as error:  # zipfile and numpy raise many kinds on damaged input
        raise MapError(f"{path}: not a map file of this program, or damaged") from error
    if not recognised:
        raise MapError(f"{path}: not a map file of this program")
    if header["version"] != VERSION:
        raise MapError(
            f"{path}: map version {header['version']}, this program reads version {VERSION}; "
            "build the map anew or update the program"
        )
    arrays = {name.removeprefix("array/"): array for name, array in contents.items()}
    if _checksum(text, arrays) != stated:
        raise MapError(f"{path}: the checksum does not match, the file is damaged; build it anew")
    return MapState(header["kind"], arrays, header["options"], header["provenance"])


def _read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > MAX_BYTES:
        raise MapError(f"{path}: unpacks to {unpacked / 1e9:.1f} GB, not a map of this program")
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def _checksum(header: bytes, arrays: dict[str, npt.NDArray[Any]]) -> bytes:
    digest = hashlib.sha256(header)
    for name, array in sorted(arrays.items()):
        digest.update(f"\0{name}\0{array.dtype.str}\0{array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.digest()

"""Maps as ``.npz`` files: plain arrays, a version, a checksum, no pickle.

The file is a zip archive of ``.npy`` members: ``header`` (JSON as bytes: format, version, kind,
options, provenance), ``checksum`` (SHA-256) and one ``arrays/<name>`` per array, those of a lidar
under ``arrays/lidar/``. Members are stored uncompressed with a fixed date, so that the same map
gives the same bytes.
"""

import hashlib
import json
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.data import LidarMap, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.bounded import NUMERIC, open_archive, read_stored_array
from l2m_gtsam.storage.files import atomic_path

FORMAT = "l2m-map"
VERSION = 3
FORMER = 2  # of maps that have nothing of what came with the present version
# Arrays of maps that are kept up, know wrong poses, or are corrected by what their suite is.
LATER = frozenset({"steps", "pose_pairs", "suite_mean"})
READ = (FORMER, VERSION)
HEADER, CHECKSUM, ARRAYS = "header.npy", "checksum.npy", "arrays/"
LIDAR = "lidar/"
LIDAR_SHAPES = {"points": (3,), "R": (3, 3), "p": (3,)}
MAX_BYTES = 512 << 20
MISSING = "no such map file; make one with `l2m map build`"

Arrays = Mapping[str, npt.NDArray[Any]]


def save_map(path: Path, state: MapState) -> None:
    """Write a map; `load_map` gives it back equal.

    Parameters
    ----------
    path
        File to write (``.npz``).
    state
        The map. Options and provenance must be plain values (JSON); tuples come back as lists.

    Raises
    ------
    MapError
        An array is not numeric, or options or provenance are not plain values.
    OutputError
        The file cannot be written.
    """
    header = _encode_header(path, state)
    everything = {**state.arrays, **_lidar_arrays(state.lidar)}
    arrays = {name: np.asarray(array, order="C") for name, array in everything.items()}
    if unfit := [name for name, array in arrays.items() if array.dtype.kind not in NUMERIC]:
        raise MapError(
            f"{path}: array {unfit[0]!r} is not numeric and cannot be part of a map file"
        )
    members = {
        HEADER: header,
        CHECKSUM: _checksum(header, arrays),
        **{f"{ARRAYS}{name}.npy": arrays[name] for name in sorted(arrays)},
    }
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in members.items():
            # A bare ZipInfo has a fixed date.
            with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def load_map(path: Path) -> MapState:
    """Return the map in a file.

    Raises
    ------
    MapError
        The file is missing, is something else, is damaged, is from a newer version or is too
        large.
    """
    with _translated(path), open_archive(path, MapError, MISSING) as archive:
        _refuse_large(path, archive)
        _refuse_foreign(path, archive)
        header = read_stored_array(archive, HEADER)
        content = _decode_header(path, header)
        arrays = {
            name.removeprefix(ARRAYS).removesuffix(".npy"): read_stored_array(archive, name)
            for name in archive.namelist()
            if name.startswith(ARRAYS)
        }
        checksum = read_stored_array(archive, CHECKSUM)
    if checksum.tobytes() != _checksum(header, arrays).tobytes():
        raise MapError(
            f"{path}: the checksum does not match, the file is damaged; build the map again"
        )
    own = {name: array for name, array in arrays.items() if not name.startswith(LIDAR)}
    lidar = _lidar(path, arrays) if len(own) < len(arrays) else None
    return MapState(content["kind"], own, content["options"], content["provenance"], lidar)


def _lidar_arrays(lidar: LidarMap | None) -> dict[str, npt.NDArray[Any]]:
    return {} if lidar is None else {f"{LIDAR}{name}": array for name, array in vars(lidar).items()}


def _lidar(path: Path, arrays: Arrays) -> LidarMap:
    """Return what a lidar saw; a MapError if it is not what it should be."""
    found = {name: arrays.get(f"{LIDAR}{name}", np.zeros(0)) for name in LIDAR_SHAPES}
    sound = all(
        found[name].dtype == np.float64
        and found[name].shape[1:] == shape
        and np.isfinite(found[name]).all()
        for name, shape in LIDAR_SHAPES.items()
    )
    if not sound or not len(found["points"]) or len(found["R"]) != len(found["p"]):
        raise MapError(f"{path}: its cloud is damaged; build the map again")
    return LidarMap(**found)


def _encode_header(path: Path, state: MapState) -> npt.NDArray[np.uint8]:
    content = {
        "format": FORMAT,
        "version": VERSION if LATER & state.arrays.keys() else FORMER,
        "kind": state.kind,
        "options": state.options,
        "provenance": state.provenance,
    }
    try:
        text = json.dumps(content, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise MapError(
            f"{path}: options and provenance of a map must be plain values: {error}"
        ) from error
    return np.frombuffer(text.encode(), dtype=np.uint8)


def _decode_header(path: Path, header: npt.NDArray[Any]) -> dict[str, Any]:
    content = json.loads(header.tobytes())
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise MapError(_foreign(path))
    if content.get("version") not in READ:
        raise MapError(
            f"{path}: map version {content.get('version')!r}, this program reads version "
            f"{' and '.join(str(each) for each in READ)}; build the map again or use the program "
            "that wrote it"
        )
    parts = {"kind": str, "options": dict, "provenance": dict}
    if not all(isinstance(content.get(key), kind) for key, kind in parts.items()):
        raise MapError(_foreign(path))
    return content


def _checksum(header: npt.NDArray[Any], arrays: Arrays) -> npt.NDArray[np.uint8]:
    """Return the SHA-256 over the header and over name, type, shape and bytes of each array."""
    digest = hashlib.sha256(header.tobytes())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(np.asarray(array, order="C").reshape(-1).view(np.uint8).data)
    return np.frombuffer(digest.digest(), dtype=np.uint8)


def _refuse_foreign(path: Path, archive: zipfile.ZipFile) -> None:
    if not {HEADER, CHECKSUM} <= set(archive.namelist()):
        raise MapError(_foreign(path))


def _refuse_large(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse what the archive's own directory says is too much, before anything is unpacked."""
    declared = sum(info.file_size for info in archive.infolist())
    if declared > MAX_BYTES:
        raise MapError(
            f"{path}: unpacks to {declared / 1e9:.1f} GB, not a map of this program; at most "
            f"{MAX_BYTES / 1e9:.1f} GB are accepted"
        )


def _foreign(path: Path) -> str:
    return (
        f"{path}: not a map file of this program, or damaged; accepted: an .npz made by "
        "`l2m map build`"
    )


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn what archive and JSON raise on bad files into one line."""
    try:
        yield
    except (ValueError, KeyError, RecursionError) as error:
        raise MapError(_foreign(path)) from error

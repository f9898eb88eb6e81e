"""The tiles of a map in a folder beside it: a file for each entry, of bounded size together.

A file is the magic number, the version and the length of the header as 8 bytes each, a SHA-256 over
all that follows it, the header (JSON: fingerprint, and name, type and shape of each array) and the
arrays, one after the other in C order. All numbers are little-endian; nothing is pickled.

A fault of the folder costs time and changes no result: tiles are then computed again. The first
fault is reported as a notice, others are not.
"""

import hashlib
import json
import os
import struct
import warnings
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from l2m_gtsam.errors import ConfigError, MapError, Notice, OutputError
from l2m_gtsam.maps.tile_store import NO_STORE, Arrays, Entry, Made, TileStore
from l2m_gtsam.storage.bounded import bytes_of, open_regular
from l2m_gtsam.storage.files import renamed_path

MAGIC = b"l2m-tile"
VERSION = 1
START = struct.Struct("<8sQQ32s")  # that, version, length of the header, checksum
MOST_BYTES, MOST_HEADER_BYTES = 1 << 28, 1 << 16
DTYPES = {each.str: each for each in (np.dtype("<f8"), np.dtype("<i8"))}


def write_tile(path: Path, entry: Entry, arrays: Arrays) -> int:
    """Write an entry, and return its size in bytes.

    It is not forced to the disk: what a power cut leaves of it does not have its checksum.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    plain = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    facts = {
        "fingerprint": entry.fingerprint,
        "arrays": [[name, each.dtype.str, each.shape] for name, each in plain.items()],
    }
    header = json.dumps(facts).encode()
    digest = hashlib.sha256(header)
    for each in plain.values():
        digest.update(each.reshape(-1).view(np.uint8).data)
    with renamed_path(path) as temporary, temporary.open("wb") as file:
        file.write(START.pack(MAGIC, VERSION, len(header), digest.digest()) + header)
        for each in plain.values():
            file.write(each.reshape(-1).view(np.uint8).data)
        return file.tell()


def read_tile(path: Path, entry: Entry) -> Arrays:
    """Return the arrays of an entry.

    Raises
    ------
    MapError
        The file is another entry, of another version, or damaged.
    OSError
        It cannot be read.
    """
    with open_regular(path) as file:
        left = os.fstat(file.fileno()).st_size
        checksum, header = _read_start(file, left)
        facts = _facts(header)
        if facts["fingerprint"] != entry.fingerprint:
            raise MapError("it is of another map or of another version of the program")
        digest = hashlib.sha256(header)
        arrays = _empty_arrays(facts, left - file.tell())
        for array in arrays.values():
            content = array.reshape(-1).view(np.uint8)
            if file.readinto(content.data) != len(content):
                raise MapError("it is cut short")
            digest.update(content.data)
    if digest.digest() != checksum:
        raise MapError("its checksum does not match")
    return arrays


def fingerprint_of(path: Path) -> str | None:
    """Return the fingerprint that a file claims to have; None if it has none."""
    try:
        with open_regular(path) as file:
            _, header = _read_start(file, os.fstat(file.fileno()).st_size)
            return str(_facts(header)["fingerprint"])
    except (MapError, OSError):
        return None


def _read_start(file: IO[bytes], size: int) -> tuple[bytes, bytes]:
    """Return checksum and header of a file of so many bytes."""
    start = file.read(START.size)
    if len(start) < START.size or not start.startswith(MAGIC):
        raise MapError("it is cut short or no tile")
    _, version, length, checksum = START.unpack(start)
    if version != VERSION:
        raise MapError(f"it is of version {version}, not {VERSION}")
    if size > MOST_BYTES or length > min(MOST_HEADER_BYTES, size - START.size):
        raise MapError("it is cut short or too large")
    return checksum, file.read(length)


def _facts(header: bytes) -> dict[str, Any]:
    try:
        facts = json.loads(header)
    except (ValueError, RecursionError):
        raise MapError("its header is damaged") from None
    if not isinstance(facts, dict) or not {"fingerprint", "arrays"} <= set(facts):
        raise MapError("its header is damaged")
    return facts


def _empty_arrays(facts: dict[str, Any], left: int) -> dict[str, npt.NDArray[Any]]:
    """Return arrays to fill, if they take just the bytes that are left."""
    shapes = {}
    try:
        for name, kind, shape in facts["arrays"]:
            shapes[str(name)] = DTYPES[kind], tuple(int(length) for length in shape)
    except (TypeError, ValueError, KeyError, OverflowError):
        raise MapError("its header is damaged") from None
    if any(length < 0 for _, shape in shapes.values() for length in shape):
        raise MapError("its header is damaged")
    if sum(bytes_of(shape, dtype) for dtype, shape in shapes.values()) != left:
        raise MapError("it is cut short or too long")
    try:
        return {name: np.empty(shape, dtype) for name, (dtype, shape) in shapes.items()}
    except (ValueError, OverflowError):  # too many axes, or too long a one beside one of none
        raise MapError("its header is damaged") from None


SUFFIX, FILE_SUFFIX = ".tiles", ".tile"
LIMIT = "L2M_TILES_GIB"
"""Environment variable: how large the folder may become; 0 keeps no tiles."""
ABOUT_A_HEADER = 2048  # bytes
ANEW = "this tile, and others like it, are made anew"
MOST_GIB = 4.0  # about two thousand tiles


def tiles_beside(map_path: Path) -> TileStore:
    """Return the store of a map's tiles: the folder of its name that ends in ``.tiles``.

    Raises
    ------
    ConfigError
        If L2M_TILES_GIB is not a size.
    """
    most = _most_bytes(os.environ.get(LIMIT) or str(MOST_GIB))
    return TileFolder(map_path.with_suffix(SUFFIX), most) if most else NO_STORE


def _most_bytes(text: str) -> int:
    try:
        size = float(text)
    except ValueError:
        size = -1.0
    if not 0 <= size < 1e6:
        raise ConfigError(f"{LIMIT}: {text!r} is not a size; accepted: 0 or more, in GiB")
    return int(size * 2**30)


class TileFolder:
    """Tiles as files; see ``TileStore``.

    Parameters
    ----------
    folder
        Made when it is first needed.
    most_bytes
        How large it may become. Each process counts for itself: two that write at once may exceed
        it by what they write.
    """

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._folder, self._most_bytes = folder, most_bytes
        self._held: int | None = None
        self._takes_more = True
        self._noticed = False
        self._lock = Lock()

    def __reduce__(self) -> tuple[type["TileFolder"], tuple[Path, int]]:
        return TileFolder, (self._folder, self._most_bytes)

    @property
    def takes_more(self) -> bool:
        """Whether what is given to it now is kept; see ``TileStore``."""
        return self._takes_more

    def recall(self, entry: Entry, decode: Callable[[Arrays], Made], /) -> Made | None:
        """Return what an entry decodes to, or None; see ``TileStore``."""
        path = self._path(entry)
        try:
            return decode(read_tile(path, entry))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            self._notice(f"{path}: cannot be read: {error.strerror or error}; {ANEW}")
        except MapError as error:
            self._notice(f"{path}: {error}; {ANEW}")
        return None

    def keep(self, entry: Entry, arrays: Arrays, /) -> None:
        """Keep an entry, if there is space for it; see ``TileStore``."""
        if not self._takes_more:
            return
        if not self._has_space(entry, sum(array.nbytes for array in arrays.values())):
            full = f"{self._folder}: holds {self._most_bytes / 2**30:.3g} GiB, as {LIMIT} allows"
            self._give_up(full)
            return
        try:
            self._folder.mkdir(exist_ok=True)
            write_tile(self._path(entry), entry, arrays)
        except OutputError as error:
            self._give_up(str(error))
        except OSError as error:
            self._give_up(f"{self._folder}: cannot be written: {error.strerror or error}")

    def sweep(self, wanted: Collection[Entry], /) -> None:
        """Remove all files but those of these entries; see ``TileStore``."""
        fingerprints = {self._path(entry): entry.fingerprint for entry in wanted}
        for path in self._files():
            claimed = fingerprint_of(path)
            if claimed is None or fingerprints.get(path) != claimed:
                with suppress(OSError):
                    path.unlink()
        with self._lock:
            self._held = None

    def _has_space(self, entry: Entry, size: int) -> bool:
        """Return whether there is space for an entry, which then counts as taken."""
        with self._lock:
            if self._held is None:
                self._held = sum(_size(path) for path in self._files())
            held = self._held - _size(self._path(entry)) + size + ABOUT_A_HEADER
            if held > self._most_bytes:
                return False
            self._held = held
            return True

    def _path(self, entry: Entry) -> Path:
        return self._folder / f"{entry.name}{FILE_SUFFIX}"

    def _files(self) -> list[Path]:
        """Return all tiles, and what is left of those that were not written to their end."""
        return [
            *self._folder.glob(f"*{FILE_SUFFIX}"),
            *self._folder.glob(f".*{FILE_SUFFIX}.*.part"),
        ]

    def _give_up(self, what: str) -> None:
        with self._lock:
            self._takes_more = False
        self._notice(f"{what}; more tiles are not kept")

    def _notice(self, what: str) -> None:
        with self._lock:
            first, self._noticed = not self._noticed, True
        if first:
            warnings.warn(what, Notice, stacklevel=2)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0

"""The tiles of a map in a folder beside it: a file for each entry, of bounded size together.

Whatever is wrong with the folder costs time, and no answer: tiles are then made anew. The first
such thing is said as a notice, others are not.
"""

import os
import warnings
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from threading import Lock

from l2m_gtsam.errors import ConfigError, MapError, Notice, OutputError
from l2m_gtsam.maps.tile_store import NO_STORE, Arrays, Entry, Made, TileStore
from l2m_gtsam.storage.tile_file import fingerprint_of, read_tile, write_tile

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

"""Point clouds: read from files (PCD, PLY, LAS, E57, NPZ), averaged over voxels, written."""

import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.bounded import ArrayMember, open_archive, opened_array
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.point_table import (
    ACCEPTED,
    MISSING,
    PIECE_POINTS,
    pcd_pieces,
    ply_pieces,
    refuse_many,
    require_bytes,
    write_ply,
)
from l2m_gtsam.storage.survey_clouds import e57_pieces, las_pieces

# Points that wait before they are merged, at least.
BATCH_POINTS = 1 << 18
# A cell's three indices are packed into one number, counted from the first point's cell.
BITS = 20
REACH_CELLS = 1 << BITS


class VoxelMeans:
    """The mean of the points in every cell of a grid, of points that come piece by piece.

    Memory grows with the cells that hold points, not with the points.

    Parameters
    ----------
    edge
        Side of the cubic cells in metres, positive; the origin is a corner of a cell.
    """

    def __init__(self, edge: float) -> None:
        self._edge = edge
        self._origin: IntArray | None = None
        # One row per cell, in order of the keys: sums of x, y and z, number of points.
        self._keys = np.zeros(0, dtype=np.int64)
        self._sums = np.zeros((0, 4))
        self._waiting: list[FloatArray] = []
        self._number_waiting = 0

    def __len__(self) -> int:
        """Return the cells known so far; points that wait to be merged are not in it."""
        return len(self._keys)

    def add(self, points: FloatArray) -> None:
        """Add finite points, shape (N, 3) in metres.

        Raises
        ------
        ValueError
            A point is more than a million cells away from the first one, or there are too many
            cells.
        """
        self._waiting.append(points)
        self._number_waiting += len(points)
        # Merging sorts all cells: seldom enough that its cost per point does not grow.
        if self._number_waiting > max(BATCH_POINTS, len(self)):
            self._merge()

    def points(self) -> FloatArray:
        """Return one point per cell that has any, in order of the cells, shape (M, 3) in metres.

        Raises
        ------
        ValueError
            As in `add`.
        """
        self._merge()
        return np.asarray(self._sums[:, :3] / self._sums[:, 3:])

    def _merge(self) -> None:
        points = np.concatenate([np.zeros((0, 3)), *self._waiting])
        self._waiting, self._number_waiting = [], 0
        if not len(points):
            return
        sums = np.concatenate([self._sums, np.column_stack([points, np.ones(len(points))])])
        keys = np.concatenate([self._keys, self._keys_of(points)])
        self._keys, cell = np.unique(keys, return_inverse=True)
        self._sums = np.column_stack([np.bincount(cell, column) for column in sums.T])
        if len(self) > MAX_CELLS:
            raise ValueError(
                f"it fills more than {MAX_CELLS:,} cells of {self._edge:g} m; choose a larger edge"
            )

    def _keys_of(self, points: FloatArray) -> IntArray:
        """Return one number per point that identifies its cell, shape (N,)."""
        cells = np.floor(points / self._edge).astype(np.int64)
        if self._origin is None:
            self._origin = cells[0]
        steps = cells - self._origin
        if np.abs(steps).max() >= REACH_CELLS:
            reach = REACH_CELLS * self._edge
            raise ValueError(
                f"it has points more than {reach:.3g} m apart, too far for cells of "
                f"{self._edge:g} m; remove those that are astray"
            )
        x, y, z = (steps + REACH_CELLS).T
        return np.asarray((x << 2 * BITS + 2) | (y << BITS + 1) | z)


NPZ_MEMBER = "points.npy"
# Held at once: 120 MB, and a few times as much while they are merged.
MAX_CELLS = 5_000_000
MAX_KEPT_POINTS = 20_000_000  # of a cloud that is not thinned: 480 MB, twice for a moment
# Further from the map's origin than any site: geographic or broken coordinates.
MAX_COORDINATE_M = 1e6


def thinned_cloud(points: FloatArray, edge: float) -> FloatArray:
    """Return the mean of the points in every cubic cell that has any.

    Parameters
    ----------
    points
        Finite points in metres, shape (N, 3).
    edge
        Side of the cells in metres, positive.

    Returns
    -------
    Points in metres in order of the cells, shape (M, 3), M <= N.

    Raises
    ------
    ValueError
        Points are more than a million cells apart.
    """
    return _collected([points], edge)


def read_cloud(path: Path, edge: float = 0.0) -> FloatArray:
    """Return the points of a cloud in the map frame.

    Coordinates are taken as they stand: the viewpoint that a PCD file may carry says where the
    scanner stood, not where the points are.

    Parameters
    ----------
    path
        A ``.pcd`` (ascii, binary, binary_compressed), ``.ply`` (ascii, binary of either byte
        order), ``.las``, ``.laz``, ``.e57`` or ``.npz`` (array ``points``, shape (N, 3)) in metres.
    edge
        Thin the cloud while reading, as `thinned_cloud` does, in metres; 0 keeps every point.

    Returns
    -------
    Finite points in metres, shape (N, 3); those that are not finite are dropped.

    Raises
    ------
    MapError
        The file is missing, of another kind, damaged, has no finite point or too many, or its
        coordinates are no metres in a map.
    """
    if path.suffix.lower() not in READERS:
        raise MapError(f"{path}: not a kind of point cloud that is read; accepted: {ACCEPTED}")
    with _translated(path):
        pieces = (located(piece, str(path)) for piece in READERS[path.suffix.lower()](path))
        points = _collected(pieces, edge)
    if not len(points):
        raise MapError(f"{path}: has no finite point; is it the right file?")
    return points


def write_cloud(path: Path, points: FloatArray) -> None:
    """Write a cloud; `read_cloud` gives it back equal.

    Parameters
    ----------
    path
        File to write: PLY, binary, float64.
    points
        Finite points in metres, shape (N, 3).

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with atomic_path(path) as temporary:
        write_ply(temporary, points)


def located(points: FloatArray, where: str) -> FloatArray:
    """Return the finite ones of points in metres, shape (N, 3).

    Raises
    ------
    MapError
        A coordinate is too large for metres in a map; ``where`` names the offender.
    """
    points = points[np.isfinite(points).all(axis=1)]
    furthest = float(np.abs(points).max(initial=0.0))
    if furthest > MAX_COORDINATE_M:
        raise MapError(
            f"{where}: has a coordinate of {furthest:.3g} m, at most {MAX_COORDINATE_M:g} m are "
            "accepted; give metres in the frame of the map, not geographic coordinates"
        )
    return points


def _collected(pieces: Iterable[FloatArray], edge: float) -> FloatArray:
    if not edge > 0:
        return np.concatenate([np.zeros((0, 3)), *_few(pieces)])
    means = VoxelMeans(edge)
    for piece in pieces:
        means.add(piece)
    return means.points()


def _few(pieces: Iterable[FloatArray]) -> Iterator[FloatArray]:
    """Yield pieces as they are, as long as all of them can be held at once."""
    count = 0
    for piece in pieces:
        count += len(piece)
        if count > MAX_KEPT_POINTS:
            raise ValueError(f"it has more than {MAX_KEPT_POINTS:,} points; thin it while reading")
        yield piece


def _npz_pieces(path: Path) -> Iterator[FloatArray]:
    with open_archive(path, MapError, MISSING) as archive:
        if NPZ_MEMBER not in archive.namelist():
            raise ValueError("it has no array `points`")
        with opened_array(archive, NPZ_MEMBER) as member:
            yield from _array_pieces(path, member)


def _array_pieces(path: Path, member: ArrayMember) -> Iterator[FloatArray]:
    shape, kind = member.shape, member.dtype
    if len(shape) != 2 or shape[1] != 3 or kind.kind not in "iuf":
        raise ValueError(f"its array `points` is {kind} of shape {shape}, not numbers (N, 3)")
    row = 3 * kind.itemsize
    require_bytes(member.size, shape[0], row)
    refuse_many(path, shape[0])
    # Column after column it is read at once.
    step = shape[0] if member.fortran else PIECE_POINTS
    if member.fortran and shape[0] > MAX_KEPT_POINTS:
        raise ValueError(f"more than {MAX_KEPT_POINTS:,} points must be in C order")
    for low in range(0, shape[0], max(step, 1)):
        count = min(step, shape[0] - low)
        data = member.file.read(count * row)
        require_bytes(len(data), count, row)
        order: Literal["C", "F"] = "F" if member.fortran else "C"
        yield np.frombuffer(data, dtype=kind).reshape((-1, 3), order=order).astype(np.float64)


@contextmanager
def _translated(path: Path) -> Iterator[None]:
    """Turn what opening and understanding a bad file raises into one line."""
    try:
        yield
    except KeyError as error:
        raise MapError(_damaged(path, f"{error} is missing or unknown")) from error
    except (IndexError, EOFError, struct.error) as error:
        raise MapError(_damaged(path, "it ends too early")) from error
    except (ValueError, OverflowError) as error:
        raise MapError(_damaged(path, str(error))) from error


def _damaged(path: Path, reason: str) -> str:
    return f"{path}: not a usable point cloud: {' '.join(reason.split())[:200]}"


READERS: dict[str, Callable[[Path], Iterator[FloatArray]]] = {
    ".pcd": pcd_pieces,
    ".ply": ply_pieces,
    ".npz": _npz_pieces,
    ".las": las_pieces,
    ".laz": las_pieces,
    ".e57": e57_pieces,
}

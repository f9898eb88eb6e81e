"""Point clouds of surveyors: LAS and LAZ with laspy, E57 with pye57, piece by piece."""

import struct
from collections.abc import Iterator
from os import SEEK_END
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.bounded import opened, require_regular
from l2m_gtsam.storage.point_table import PIECE_POINTS, refuse_many

MISSING = "reading it needs {}: install l2m-gtsam with its extra `clouds`"
HEADER_BYTES, RECORD_BYTES = 227, 54  # of LAS: the header's first part, the head of a record
AXES = ("cartesianX", "cartesianY", "cartesianZ")


def las_pieces(path: Path) -> Iterator[FloatArray]:
    """Yield the points of a LAS or LAZ file in metres of its coordinate system, shape (N, 3).

    Raises
    ------
    MapError
        laspy is not installed, or the file has too many points.
    ValueError
        The file is damaged.
    """
    try:
        import laspy
    except ImportError as error:
        raise MapError(f"{path}: {MISSING.format('laspy')}") from error
    _check_records(path)
    try:
        with (
            opened(path, MapError) as file,
            laspy.open(file, closefd=False, read_evlrs=False) as reader,
        ):
            refuse_many(path, int(reader.header.point_count))
            if reader.header.are_points_compressed:
                _check_chunks(path, reader.header.offset_to_point_data, reader.header.point_count)
            for piece in reader.chunk_iterator(PIECE_POINTS):
                with np.errstate(over="ignore", invalid="ignore"):
                    columns = [np.asarray(each) for each in (piece.x, piece.y, piece.z)]
                yield np.column_stack(columns)
    except MemoryError as error:
        raise ValueError("it declares more than fits into memory") from error
    except (laspy.errors.LaspyException, RuntimeError) as error:
        raise ValueError(str(error)) from error
    except BaseException as error:
        # What lazrs, which is compiled, panics with on damaged data is no Exception.
        if isinstance(error, Exception | GeneratorExit | KeyboardInterrupt):
            raise
        raise ValueError(str(error)) from error


def _check_records(path: Path) -> None:
    """Raise a ValueError for a LAS file that declares more records than there is room for.

    laspy reads as many as are declared, also when nothing comes any more.
    """
    with opened(path, MapError) as file:
        head = file.read(HEADER_BYTES)
        if len(head) < HEADER_BYTES or head[:4] != b"LASF":
            raise ValueError("it does not begin as a LAS file does")
        size, start, records = struct.unpack_from("<HII", head, 94)
    if start > path.stat().st_size or size + RECORD_BYTES * records > start:
        raise ValueError(f"it declares {records} records before its points, which do not fit there")


def _check_chunks(path: Path, start: int, points: int) -> None:
    """Raise a ValueError for a LAZ file with more chunks than points.

    What unpacks it makes room for as many as are declared before it reads any, and ends the whole
    program where there is none.
    """
    with opened(path, MapError) as file:
        file.seek(start)
        (table,) = struct.unpack("<q", file.read(8))
        if table <= 0:  # written by a stream: the place is at the end
            file.seek(-8, SEEK_END)
            (table,) = struct.unpack("<q", file.read(8))
        file.seek(max(table, 0))
        _, chunks = struct.unpack("<II", file.read(8))
    if chunks > points:
        raise ValueError(f"it declares {chunks} chunks of {points} points")


def e57_pieces(path: Path) -> Iterator[FloatArray]:
    """Yield the points of all scans of an E57 file in its common frame, metres, shape (N, 3).

    Raises
    ------
    MapError
        pye57 is not installed, or the file has too many points.
    ValueError
        The file is damaged, or a scan has no cartesian or spherical coordinates.
    """
    try:
        import pye57
        from pye57 import libe57
    except ImportError as error:
        raise MapError(f"{path}: {MISSING.format('pye57')}") from error
    require_regular(path, MapError)
    try:
        file = pye57.E57(str(path))
        with file:
            total = 0
            for index in range(file.scan_count):
                total += int(file.get_header(index).point_count)
            refuse_many(path, total)
            for index in range(file.scan_count):
                scan = file.read_scan(index, ignore_missing_fields=True)
                points = np.column_stack([scan[axis] for axis in AXES]).astype(np.float64)
                for low in range(0, len(points), PIECE_POINTS):
                    yield points[low : low + PIECE_POINTS]
    except (libe57.E57Exception, RuntimeError) as error:
        raise ValueError(str(error)) from error

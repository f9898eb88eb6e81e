"""Point clouds of surveyors: LAS and LAZ with laspy, E57 with pye57, piece by piece."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.bounded import opened, require_regular
from l2m_gtsam.storage.point_table import PIECE_POINTS, refuse_many

MISSING = "reading it needs {}: install l2m-gtsam with its extra `clouds`"
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
    try:
        with opened(path, MapError) as file, laspy.open(file, closefd=False) as reader:
            refuse_many(path, int(reader.header.point_count))
            for piece in reader.chunk_iterator(PIECE_POINTS):
                yield np.column_stack([np.asarray(each) for each in (piece.x, piece.y, piece.z)])
    except (laspy.errors.LaspyException, RuntimeError) as error:
        raise ValueError(str(error)) from error
    except BaseException as error:
        # What lazrs, which is compiled, panics with on damaged data is no Exception.
        if isinstance(error, Exception | GeneratorExit | KeyboardInterrupt):
            raise
        raise ValueError(str(error)) from error


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

"""Clouds that surveyors deliver, as the formats' own libraries write them."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage.cloud import read_cloud

POINTS = np.random.default_rng(3).uniform(-20, 20, (500, 3))


def las(path: Path, points: FloatArray = POINTS) -> Path:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(points[0])
    content = laspy.LasData(header)
    content.x, content.y, content.z = points.T
    content.write(path)
    return path


def e57(path: Path, points: FloatArray = POINTS) -> tuple[Path, FloatArray]:
    """Two scans, each from a place of its own; and their points in the common frame."""
    turn = Rotation.from_euler("z", 90, degrees=True)
    q = turn.as_quat()[[3, 0, 1, 2]]
    with pye57.E57(str(path), mode="w") as file:
        for part, where in ((points[:300], [0, 0, 0]), (points[300:], [5.0, 0, 1.0])):
            columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), part.T, strict=True))
            file.write_scan_raw(columns, rotation=q, translation=np.array(where))
    second = turn.apply(points[300:]) + np.array([5.0, 0, 1.0])
    return path, np.concatenate([turn.apply(points[:300]), second])


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_and_laz(tmp_path: Path, suffix: str) -> None:
    found = read_cloud(las(tmp_path / f"cloud{suffix}"))
    np.testing.assert_allclose(found, POINTS, atol=0.0005 + 1e-9)  # written to the millimetre


def test_e57_in_the_common_frame(tmp_path: Path) -> None:
    path, expected = e57(tmp_path / "cloud.e57")
    np.testing.assert_allclose(read_cloud(path), expected, atol=1e-6)
    assert len(read_cloud(path, edge=5.0)) < 500


@pytest.mark.parametrize("suffix", [".las", ".laz", ".e57"])
def test_damaged_files_are_one_line(tmp_path: Path, suffix: str) -> None:
    good = tmp_path / f"good{suffix}"
    if suffix == ".e57":
        e57(good)
    else:
        las(good)
    content = good.read_bytes()
    path = tmp_path / f"bad{suffix}"
    for share in (0, 3, 100, len(content) // 2):
        path.write_bytes(content[:share])
        with pytest.raises(MapError) as error:
            read_cloud(path)
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)


def test_more_than_fits_is_refused_before_it_is_read(tmp_path: Path) -> None:
    """Else laspy counts to four thousand million, and what unpacks LAZ ends the program."""
    content = bytearray(las(tmp_path / "good.laz").read_bytes())
    path = tmp_path / "bad.laz"
    many = content.copy()
    struct.pack_into("<I", many, 100, 2**32 - 1)  # records
    path.write_bytes(many)
    with pytest.raises(MapError, match="declares 4294967295 records"):
        read_cloud(path)
    (start,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, start)
    struct.pack_into("<I", content, table + 4, 2**32 - 1)  # chunks
    path.write_bytes(content)
    with pytest.raises(MapError, match="declares 4294967295 chunks of 500 points"):
        read_cloud(path)


def test_geographic_coordinates_are_refused(tmp_path: Path) -> None:
    path = las(tmp_path / "utm.las", POINTS + np.array([5e5, 5.4e6, 0]))
    with pytest.raises(MapError, match="not geographic coordinates"):
        read_cloud(path)

"""Point clouds in files: round trips, files of other programs, and everything that may be wrong."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pypcd4.pypcd4 import Encoding, PointCloud

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.storage import cloud, point_table
from l2m_gtsam.storage.cloud import VoxelMeans, read_cloud, thinned_cloud, write_cloud

POINTS = np.array([[1.0, 2.0, 3.0], [-4.5, 0.25, 8.0], [0.0, 1e5, -2.5]])
METRES = st.floats(-cloud.MAX_COORDINATE_M, cloud.MAX_COORDINATE_M)
NEAR, NEAR_SINGLE = st.floats(-1e3, 1e3), st.floats(-1000, 1000, width=32)

many_clouds = settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def clouds(elements: st.SearchStrategy[float]) -> st.SearchStrategy[FloatArray]:
    return hnp.arrays(np.float64, st.tuples(st.integers(1, 40), st.just(3)), elements=elements)


def written(path: Path, content: bytes | str) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def pcd_header(data: str, points: int, **changes: str) -> str:
    lines = {
        "VERSION": "0.7",
        "FIELDS": "x y z",
        "SIZE": "4 4 4",
        "TYPE": "F F F",
        "COUNT": "1 1 1",
        "WIDTH": str(points),
        "HEIGHT": "1",
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": str(points),
        **changes,
        "DATA": data,
    }
    body = "".join(f"{key} {value}\n" for key, value in lines.items() if value)
    return f"# .PCD v0.7 - Point Cloud Data file format\n{body}"


def ply_header(form: str, points: int, properties: str = "float x,float y,float z") -> str:
    lines = "".join(f"property {each}\n" for each in properties.split(","))
    return f"ply\nformat {form} 1.0\nelement vertex {points}\n{lines}end_header\n"


def written_cloud(path: Path, points: FloatArray) -> None:
    """A cloud of this program, or of numpy."""
    if path.suffix == ".npz":
        np.savez(path, points=points)
    else:
        write_cloud(path, points)


@pytest.mark.parametrize("suffix", [".ply", ".npz"])
@many_clouds
@given(points=clouds(METRES))
def test_what_is_written_reads_back_equal(tmp_path: Path, suffix: str, points: FloatArray) -> None:
    path = tmp_path / f"cloud{suffix}"
    written_cloud(path, points)
    np.testing.assert_array_equal(read_cloud(path), points)


def test_the_same_cloud_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.ply", "b.ply"):
        write_cloud(tmp_path / name, POINTS)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("encoding", [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED])
@many_clouds
@given(points=clouds(NEAR_SINGLE))
def test_pcd_of_another_program(tmp_path: Path, encoding: Encoding, points: FloatArray) -> None:
    path = tmp_path / "cloud.pcd"
    points = np.repeat(points, 4, axis=0)  # what does not shrink would be saved as it is
    columns = [*points.T.astype(np.float32), np.arange(len(points), dtype=np.uint16)]
    types = [np.float32, np.float32, np.float32, np.uint16]
    PointCloud.from_points(columns, ("x", "y", "z", "ring"), types).save(path, encoding)
    assert f"DATA {encoding.value}\n".encode() in path.read_bytes()
    # Binary is exact, text is written with ten decimals.
    atol = 1e-10 if encoding is Encoding.ASCII else 0
    np.testing.assert_allclose(read_cloud(path), points, rtol=0, atol=atol)


def test_ascii_pcd_by_hand(tmp_path: Path) -> None:
    """Tabs, runs of spaces, trailing ones, empty lines, line ends of Windows, columns between."""
    header = pcd_header(
        "ascii", 3, FIELDS="n z x y", SIZE="4 8 8 4", TYPE="U F F F", COUNT="2 1 1 1"
    )
    body = "7 8 3 1 2\n9  9\t8.0 -4.5 0.25 \n\n0 0 -2.5 0 1e5\n"
    path = written(tmp_path / "a.PCD", (header + body).replace("\n", "\r\n"))
    np.testing.assert_array_equal(read_cloud(path), POINTS)


def test_old_pcd_without_count_and_points(tmp_path: Path) -> None:
    header = pcd_header("binary", 3, VERSION=".5", COUNT="", POINTS="", VIEWPOINT="")
    path = written(tmp_path / "a.pcd", header.encode() + POINTS.astype("<f4").tobytes())
    np.testing.assert_array_equal(read_cloud(path), POINTS)


def test_compressed_pcd_by_hand(tmp_path: Path) -> None:
    """A literal, then a copy that reaches into itself: 1, 1, 1 as float32, x, y and z alike."""
    one = struct.pack("<f", 1.0)
    # Copies 7 + 23 + 2 = 32 bytes from 4 bytes back: three points of 12 bytes with the literal.
    packed = bytes([3]) + one + bytes([7 << 5, 23, 3])
    body = struct.pack("<II", len(packed), 36) + packed
    path = written(tmp_path / "a.pcd", pcd_header("binary_compressed", 3).encode() + body)
    np.testing.assert_array_equal(read_cloud(path), np.ones((3, 3)))


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply_by_hand(tmp_path: Path, order: str) -> None:
    """Integers and other properties between, an element before, faces behind."""
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = (
        f"ply\nformat {form} 1.0\ncomment by hand\nelement origin 2\nproperty double at\n"
        "element vertex 2\nproperty uchar red\nproperty short z\nproperty double y\n"
        "property float32 x\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = struct.pack(f"{order}2d BhdfBhdf", 0.5, 0.5, 255, -3, 2.25, 1.5, 0, 4, -8.0, 0.5)
    assert len(records) == 16 + 2 * 15, "struct must not pad"
    path = written(tmp_path / "a.ply", header.encode() + records + b"\x03" + bytes(12))
    np.testing.assert_array_equal(read_cloud(path), [[1.5, 2.25, -3.0], [0.5, -8.0, 4.0]])


def test_ascii_ply_by_hand(tmp_path: Path) -> None:
    header = ply_header("ascii", 2).replace(
        "element vertex", "element camera 1\nproperty int a\nelement vertex"
    )
    path = written(tmp_path / "a.ply", header + "9\n1 2 3\n-4.5 2.5e-1 8\n")
    np.testing.assert_array_equal(read_cloud(path), POINTS[:2])


@pytest.mark.parametrize("kind", ["<f4", ">f8", "<i2"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npz_of_any_numbers(tmp_path: Path, kind: str, order: str) -> None:
    points = np.array([[1, 2, 3], [4, 5, -6]], dtype=kind)
    ordered = np.asfortranarray(points) if order == "F" else points
    np.savez_compressed(tmp_path / "a.npz", points=ordered, other=np.array(1))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.npz"), [[1, 2, 3], [4, 5, -6]])


def test_long_files_are_read_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (1003, 3)).round(3)
    text = "\n".join(f"{x:.3f} {y:.3f} {z:.3f}" for x, y, z in points)
    written(tmp_path / "a.pcd", pcd_header("ascii", 1003) + text)
    for name in ("a.ply", "a.npz"):
        written_cloud(tmp_path / name, points)
    for module in (cloud, point_table):
        monkeypatch.setattr(module, "PIECE_POINTS", 100)
    monkeypatch.setattr(point_table, "PIECE_BYTES", 2400)
    monkeypatch.setattr(cloud, "BATCH_POINTS", 50)
    for name in ("a.pcd", "a.ply", "a.npz"):
        np.testing.assert_array_equal(read_cloud(tmp_path / name), points)
        # Sums in another order: rounding only.
        np.testing.assert_allclose(
            read_cloud(tmp_path / name, edge=0.5), thinned_cloud(points, 0.5), atol=1e-12
        )


def test_what_is_not_finite_is_dropped(tmp_path: Path) -> None:
    points = np.array([[np.nan, 0, 0], [1, 2, 3], [0, np.inf, 0], [0, 0, -np.inf]])
    for name in ("a.ply", "a.npz"):
        written_cloud(tmp_path / name, points)
        np.testing.assert_array_equal(read_cloud(tmp_path / name), [[1, 2, 3]])
    path = written(tmp_path / "a.pcd", pcd_header("ascii", 2) + "nan nan nan\n1 2 3\n")
    np.testing.assert_array_equal(read_cloud(path), [[1, 2, 3]])


@settings(max_examples=30)
@given(points=clouds(NEAR), edge=st.floats(0.02, 50.0), cut=st.integers(0, 40))
def test_thinning_gives_the_mean_of_every_cell(points: FloatArray, edge: float, cut: int) -> None:
    cells: dict[tuple[int, ...], list[FloatArray]] = {}
    for point in points:
        cells.setdefault(tuple(np.floor(point / edge).astype(int)), []).append(point)
    expected = [np.mean(cells[key], axis=0) for key in sorted(cells)]
    # Sums of at most 40 numbers below 1e3 in another order: rounding.
    np.testing.assert_allclose(thinned_cloud(points, edge), expected, atol=1e-11)
    means = VoxelMeans(edge)
    for part in (points[:cut], points[cut:]):
        means.add(part)
        means.points()
    np.testing.assert_allclose(means.points(), expected, atol=1e-11)


def test_thinning_refuses_what_is_too_far_apart() -> None:
    with pytest.raises(ValueError, match=r"points more than 1\.05e\+04 m apart"):
        thinned_cloud(np.array([[0.0, 0, 0], [0, 2e4, 0]]), 0.01)


def complaint(path: Path) -> str:
    """The one line about a file that names it."""
    with pytest.raises(MapError) as caught:
        read_cloud(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    return line


def test_missing_foreign_and_unknown_files(tmp_path: Path) -> None:
    assert "no such point cloud" in complaint(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    assert "cannot be read" in complaint(tmp_path / "folder.ply")
    assert ".pcd, .ply, .las" in complaint(written(tmp_path / "a.xyz", "1 2 3"))
    for suffix in ("pcd", "ply", "npz"):
        for content in (b"", b"hello\n", bytes(range(256)) * 600, b"\n" * 300_000):
            assert "not a usable point cloud" in complaint(
                written(tmp_path / f"f.{suffix}", content)
            )


FLOATS = np.ones((5, 3), "<f4").tobytes()


@pytest.mark.parametrize(
    ("header", "body", "reason"),
    [
        (pcd_header("binary", 6), FLOATS, "declares 6 x 12 bytes, 60 are there"),
        (pcd_header("binary", 10**9), FLOATS, "at most 50000000"),
        (pcd_header("binary", 5, COUNT="1 1 2000000000"), FLOATS, "bytes, 60 are there"),
        (pcd_header("binary", 5, COUNT="1 1 -1"), FLOATS, "negative"),
        (pcd_header("binary", -5), FLOATS, "negative"),
        (pcd_header("binary", 5, COUNT="2 1 1"), FLOATS * 2, "not single numbers"),
        (pcd_header("binary", 5, FIELDS="x y y"), FLOATS, "properties x, y and z"),
        (pcd_header("binary", 5, FIELDS="x y"), FLOATS, "not of one length"),
        (pcd_header("binary", 5, FIELDS=""), FLOATS, "'FIELDS' is missing"),
        (pcd_header("binary", 5, SIZE="4 4 3"), FLOATS, "'F3' is missing or unknown"),
        (pcd_header("binary", 5, POINTS="many"), FLOATS, "many"),
        (pcd_header("zipped", 5), FLOATS, "its DATA is 'zipped'"),
        (pcd_header("ascii", 5), b"1 2 3\n4 5 6\n", "declares 5 points and has 2"),
        (pcd_header("ascii", 2), b"1 2 3\n4 5\n", "not a usable point cloud"),
        (pcd_header("ascii", 1), b"1 2 z\n", "not a usable point cloud"),
        (pcd_header("ascii", 1), b"1 2 3" + b" 0" * 10_000, "line of more than"),
        (pcd_header("ascii", 0), b"", "no finite point"),
        (pcd_header("ascii", 1), b"5e5 5.4e6 0\n", "geographic"),
        (pcd_header("binary_compressed", 5), b"\0\0", "ends too early"),
        (pcd_header("binary_compressed", 5), struct.pack("<II", 9, 60), "declares 9 x 1 bytes"),
        (pcd_header("binary_compressed", 5), struct.pack("<II", 0, 59), "declares 5 x 12 bytes"),
        (pcd_header("binary_compressed", 5), struct.pack("<II", 0, 60), "does not hold the 60"),
        (
            pcd_header("binary_compressed", 5),
            struct.pack("<II", 2, 60) + b"\x20\x05",
            "refers to what is not there",
        ),
        (
            pcd_header("binary_compressed", 5),
            struct.pack("<II", 2, 0xFFFFFFF0) + b"\x20\x05",
            "at most 536870912",
        ),
    ],
)
def test_pcd_that_lies_or_is_damaged(tmp_path: Path, header: str, body: bytes, reason: str) -> None:
    with pytest.raises(MapError, match=reason):
        read_cloud(written(tmp_path / "a.pcd", header.encode() + body))
    complaint(tmp_path / "a.pcd")


@pytest.mark.parametrize(
    ("header", "body", "reason"),
    [
        (ply_header("binary_little_endian", 6), FLOATS, "declares 6 x 12 bytes, 60 are there"),
        (ply_header("binary_little_endian", 10**10), FLOATS, "at most 50000000"),
        (ply_header("middle_endian", 5), FLOATS, "'middle_endian' is missing or unknown"),
        (ply_header("ascii", 10**7), b"1 2 3\n", "declares 10000000 points and has 1"),
        (ply_header("ascii", 1, "float x,float y"), b"1 2\n", "properties x, y and z"),
        (ply_header("ascii", 1, "float x,float y,quad z"), b"1 2 3\n", "'quad' is missing"),
        (ply_header("ascii", 1, "float x,list int int z"), b"1 2 3\n", "have a list"),
        (ply_header("ascii", 1).replace("vertex", "point"), b"1 2 3\n", "no element `vertex`"),
        (ply_header("ascii", 1).replace("end_header", "comment"), b"1 2 3\n", "no end"),
        (ply_header("ascii", 1).replace("float z", "z"), b"1 2 3\n", "a line 'property z'"),
        (
            ply_header("binary_big_endian", 5).replace(
                "element", "element huge 99999999999999999999\nproperty int a\nelement"
            ),
            FLOATS,
            "not a usable point cloud",
        ),
    ],
)
def test_ply_that_lies_or_is_damaged(tmp_path: Path, header: str, body: bytes, reason: str) -> None:
    with pytest.raises(MapError, match=reason):
        read_cloud(written(tmp_path / "a.ply", header.encode() + body))
    complaint(tmp_path / "a.ply")


def test_npz_that_is_no_cloud(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    for points, reason in (
        (np.eye(4), "of shape"),
        (np.zeros(3), "of shape"),
        (np.array([[{}, 1, 2]], dtype=object), "object"),
        (np.array([["a", "b", "c"]]), "<U1"),
        (np.zeros((0, 3)), "no finite point"),
    ):
        np.savez(path, points=points)
        assert reason in complaint(path)
    np.savez(path, cloud=np.eye(3))
    assert "no array `points`" in complaint(path)


def test_npz_that_lies(tmp_path: Path) -> None:
    """The header of the array declares more than the archive holds."""
    for shape, reason in (((10**9, 3), "are there"), ((4, 3), "are there"), ((-1, 3), "")):
        array = io.BytesIO()
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(array, header)
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("points.npy", array.getvalue() + np.eye(3).tobytes())
        assert reason in complaint(tmp_path / "a.npz")


@pytest.mark.parametrize("name", ["a.ply", "a.npz", "a.pcd"])
@many_clouds
@given(where=st.floats(0, 0.999), flip=st.integers(1, 255))
def test_any_changed_byte_gives_one_line_or_points(
    tmp_path: Path, name: str, where: float, flip: int
) -> None:
    path = tmp_path / name
    if path.suffix == ".pcd":
        columns = list(np.repeat(POINTS, 9, axis=0).T.astype(np.float32))
        types = [np.float32] * 3
        PointCloud.from_points(columns, ("x", "y", "z"), types).save(
            path, Encoding.BINARY_COMPRESSED
        )
    else:
        written_cloud(path, POINTS)
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= flip
    path.write_bytes(data)
    line, points = outcome(path)
    assert "\n" not in line
    assert line.startswith(f"{path}: ") or len(points)
    assert points.shape[1] == 3
    assert np.isfinite(points).all()


def outcome(path: Path) -> tuple[str, FloatArray]:
    """The complaint about a file, or its points."""
    try:
        return "", read_cloud(path)
    except MapError as error:
        return str(error), np.empty((0, 3))


@pytest.mark.parametrize("name", ["a.ply", "a.npz"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated_files(tmp_path: Path, name: str, share: float) -> None:
    written_cloud(tmp_path / name, POINTS)
    data = (tmp_path / name).read_bytes()
    assert "not a usable" in complaint(written(tmp_path / name, data[: int(share * len(data))]))

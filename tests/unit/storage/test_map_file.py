"""Map files: round trip, determinism, and everything that may be wrong with them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray, LidarMap, MapState
from l2m_gtsam.errors import MapError, OutputError
from l2m_gtsam.storage import map_file
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.map_file import load_map, save_map


def state() -> MapState:
    arrays = {"points": np.arange(12.0).reshape(4, 3), "blocks": np.array([1, 2], dtype=np.int64)}
    return MapState("sliding_gp", arrays, {"margin": 2.0}, {"bags": [{"path": "a", "sha256": "b"}]})


def test_it_reads_back_equal_and_is_deterministic(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        save_map(tmp_path / name, state())
    back = load_map(tmp_path / "a.npz")
    assert (back.kind, back.options, back.provenance) == (
        state().kind,
        state().options,
        state().provenance,
    )
    for name, array in state().arrays.items():
        np.testing.assert_array_equal(back.arrays[name], array)
        assert back.arrays[name].dtype == array.dtype
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(where=st.floats(0, 0.999), flip=st.integers(1, 255))
def test_any_changed_byte_is_noticed_or_harmless(tmp_path: Path, where: float, flip: int) -> None:
    """A flipped byte gives one line, or (in the archive's own bookkeeping) the same map."""
    path = tmp_path / "m.npz"
    save_map(path, state())
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= flip
    path.write_bytes(data)
    complaint, points = read_points(path)
    if complaint:
        assert "\n" not in complaint
        assert str(path) in complaint
    else:
        np.testing.assert_array_equal(points, state().arrays["points"])


def read_points(path: Path) -> tuple[str, FloatArray]:
    """Return the complaint about a file, or its points."""
    try:
        return "", load_map(path).arrays["points"]
    except MapError as error:
        return str(error), np.empty(0)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_truncated_files(tmp_path: Path, share: float) -> None:
    path = tmp_path / "m.npz"
    save_map(path, state())
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(MapError, match="not a map file of this program, or damaged"):
        load_map(path)


def test_foreign_files(tmp_path: Path) -> None:
    np.savez(tmp_path / "foreign.npz", a=np.eye(3))
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "pickle.npz", header=np.array([{}], dtype=object))
    for name in ("foreign.npz", "text.npz", "pickle.npz"):
        with pytest.raises(MapError, match="not a map file"):
            load_map(tmp_path / name)
    with pytest.raises(MapError, match=r"no such map file; make one with `l2m map build`"):
        load_map(tmp_path / "nowhere.npz")


def rewritten_header(path: Path, **changes: object) -> None:
    with np.load(path) as archive:
        contents = dict(archive)
    header = {**json.loads(contents["header"].tobytes()), **changes}
    contents["header"] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    np.savez(path, **contents)


@pytest.mark.parametrize("version", [1, 99])
def test_another_version_says_what_to_do(tmp_path: Path, version: int) -> None:
    save_map(tmp_path / "m.npz", state())
    rewritten_header(tmp_path / "m.npz", version=version)
    with pytest.raises(
        MapError, match=rf"map version {version}, this program reads version 2 and 3"
    ):
        load_map(tmp_path / "m.npz")


def test_the_checksum_covers_the_header(tmp_path: Path) -> None:
    save_map(tmp_path / "m.npz", state())
    rewritten_header(tmp_path / "m.npz", options={"margin": 3.0})
    with pytest.raises(MapError, match="checksum does not match"):
        load_map(tmp_path / "m.npz")


def test_a_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """8 MB of zeros compress to 8 kB; what the archive declares is refused before it is read."""
    monkeypatch.setattr(map_file, "MAX_BYTES", 1_000_000)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, header=np.zeros(1_000_000))
    assert path.stat().st_size < 20_000
    with pytest.raises(MapError, match=r"unpacks to 0.0 GB"):
        load_map(path)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "result.yaml"
    path.write_text("old")

    def fail() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half")
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"), atomic_path(tmp_path / "no" / "a"):
        pass


def with_cloud(**changes: FloatArray) -> MapState:
    """A map that three scans saw, and two places of the mapping drive."""
    parts: dict[str, FloatArray] = {
        "points": np.arange(9.0).reshape(3, 3),
        "R": np.stack([np.eye(3), np.eye(3)]),
        "p": np.arange(6.0).reshape(2, 3),
    }
    return replace(state(), lidar=LidarMap(**(parts | changes)))


def test_the_cloud_of_a_lidar_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save_map(path, with_cloud())
    back = load_map(path)
    assert back.lidar is not None
    assert set(back.arrays) == set(state().arrays)  # a kind of map never sees it
    for name, array in vars(with_cloud().lidar).items():
        np.testing.assert_array_equal(getattr(back.lidar, name), array)
    save_map(path, state())
    assert load_map(path).lidar is None


@pytest.mark.parametrize(
    "changes",
    [
        {"points": np.zeros((0, 3))},
        {"points": np.zeros((3, 2))},
        {"points": np.full((3, 3), np.nan)},
        {"points": np.zeros((3, 3), dtype=np.float32)},
        {"p": np.zeros((5, 3))},
        {"R": np.zeros((2, 3))},
    ],
    ids=["empty", "flat", "nan", "float32", "places", "rotations"],
)
def test_a_cloud_that_is_none_is_refused(tmp_path: Path, changes: dict[str, FloatArray]) -> None:
    """A file may be written by anybody, checksum and all."""
    path = tmp_path / "a.npz"
    save_map(path, with_cloud(**changes))
    with pytest.raises(MapError, match="its cloud is damaged; build the map again"):
        load_map(path)

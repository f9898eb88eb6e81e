"""Trajectories as text: what is written comes back, and what is none is one line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.pose_files import read_tum
from l2m_gtsam.storage.trajectory_files import tum_text, write_tum

LINE = "1700000000.5 1 2 3 0 0 0 1"
LATER = "1700000001.5 1 2 3 0 0 0 1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tum")


@given(
    st.lists(st.integers(0, 2**62), min_size=2, max_size=6, unique=True),
    arrays(float, (6, 3), elements=st.floats(-1e5, 1e5)),
    st.integers(0, 2**32 - 1),
)
def test_poses_come_back(folder: Path, stamps: list[int], p: FloatArray, seed: int) -> None:
    count = len(stamps)
    R = Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()
    written = Trajectory(np.sort(stamps), R, p[:count], "map", "lidar")
    write_tum(folder / "a.tum", written)
    found = read_tum(folder / "a.tum")
    np.testing.assert_array_equal(found.stamp_ns, written.stamp_ns)
    # Nine digits of metres and of a quaternion.
    np.testing.assert_allclose(found.p, written.p, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.R, written.R, rtol=0, atol=1e-8)
    assert tum_text(found).splitlines()[0].startswith("#")


def test_order_comments_and_repeated_stamps(folder: Path) -> None:
    path = folder / "b.tum"
    path.write_text(f"# map\n\n{LATER}\n  {LINE}  # first\n1.7000000005e9 9 9 9 0 0 0 2\n")
    found = read_tum(path)
    assert found.stamp_ns.tolist() == [1_700_000_000_500_000_000, 1_700_000_001_500_000_000]
    np.testing.assert_array_equal(found.p, [[1, 2, 3], [1, 2, 3]])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (LINE, "holds 1 poses; two or more"),
        (f"{LINE}\n1 2 3", "line 2: 3 columns; expected: stamp x y z"),
        (f"{LINE}\nnow 1 2 3 0 0 0 1", "line 2: 'now' is no time"),
        (f"{LINE}\n1e999999999 1 2 3 0 0 0 1", "line 2: '1e999999999' is no time"),
        (
            "stamp x y z qx qy qz qw",
            "line 1: 'stamp' is no time in seconds; expected in a line: st",
        ),
        ("1,1,2,3,0,0,0,1", "line 1: '1,1,2,3,0,0,0,1' is no time in seconds; expected in a line"),
        (f"{LINE}\nnan 1 2 3 0 0 0 1", "line 2: 'nan' is no time"),
        (f"{LINE}\n1 1 2 inf 0 0 0 1", "line 2: a number is not finite"),
        (f"{LINE}\n1 1 2 x 0 0 0 1", "line 2: could not convert"),
        (f"{LINE}\n1 1 2 3 0 0 0 0", "line 2: an orientation is all zero"),
    ],
)
def test_what_is_no_trajectory_is_told(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "wrong.tum"
    path.write_text(text)
    with pytest.raises(BagError) as raised:
        read_tum(path)
    assert str(raised.value).startswith(f"{path}: {told}")


def test_other_files_are_told(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no such file"):
        read_tum(tmp_path / "none.tum")
    binary = tmp_path / "binary.tum"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BagError, match="it is no text"):
        read_tum(binary)

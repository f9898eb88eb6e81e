"""Files of poses that others write are read as they were meant."""

from pathlib import Path

import numpy as np
import pytest
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag_options import ColumnOptions, PoseFileOptions, TimeUnit
from l2m_gtsam.storage.pose_files import read_poses

COUNT = 20
POSITIONS = [f"p_RS_R_{axis} [m]" for axis in "xyz"]
EUROC = ", ".join(["#timestamp", *POSITIONS, *(f"q_RS_{axis} []" for axis in "wxyz")])


@pytest.fixture
def drive() -> PoseTrajectory3D:
    rng = np.random.default_rng(5)
    R = Rotation.random(COUNT, rng=rng).as_quat()
    p, stamps = rng.normal(size=(COUNT, 3)), 1_700_000_000.25 + 0.5 * np.arange(COUNT)
    return PoseTrajectory3D(p, R[:, [3, 0, 1, 2]], stamps)


def check(path: Path, options: PoseFileOptions, drive: PoseTrajectory3D) -> None:
    found = read_poses(path, options)
    # Stamps are quarters of a second, which a double holds.
    np.testing.assert_array_equal(found.stamp_ns, np.round(4 * drive.timestamps) * 250_000_000)
    np.testing.assert_allclose(found.p, drive.positions_xyz, atol=1e-9)
    expected = np.array(drive.poses_se3)[:, :3, :3]
    np.testing.assert_allclose(found.R, expected, atol=1e-9)


def test_tum_as_evo_writes_it(tmp_path: Path, drive: PoseTrajectory3D) -> None:
    file_interface.write_tum_trajectory_file(tmp_path / "a.txt", drive)
    check(tmp_path / "a.txt", PoseFileOptions(), drive)


def test_kitti_as_evo_writes_it(tmp_path: Path, drive: PoseTrajectory3D) -> None:
    path, times = tmp_path / "00.txt", tmp_path / "times.txt"
    file_interface.write_kitti_poses_file(path, PosePath3D(poses_se3=drive.poses_se3))
    times.write_text("\n".join(map(repr, drive.timestamps.tolist())))
    check(path, PoseFileOptions(times=times), drive)
    with pytest.raises(BagError, match=r"hold no times; give a file .* `--pose-times`"):
        read_poses(path, PoseFileOptions())
    times.write_text("1.0\n2.0\n")
    with pytest.raises(BagError, match=r"has 20 poses, .*times.txt has 2 times"):
        read_poses(path, PoseFileOptions(times=times))
    path.write_text("1 0 0 0 0 1 0 0 0 0 2 0\n" * 2)
    with pytest.raises(BagError, match="line 1: the matrix holds no rotation"):
        read_poses(path, PoseFileOptions(times=times))


def test_euroc_as_evo_reads_it(tmp_path: Path, drive: PoseTrajectory3D) -> None:
    path = tmp_path / "data.csv"
    stamps = np.round(4 * drive.timestamps).astype(int) * 250_000_000
    numbers = np.column_stack([drive.positions_xyz, drive.orientations_quat_wxyz])
    rows = [
        ",".join(map(str, [s, *n])) for s, n in zip(stamps.tolist(), numbers.tolist(), strict=True)
    ]
    path.write_text("\n".join([EUROC, *rows]))
    theirs = file_interface.read_euroc_csv_trajectory(path)
    np.testing.assert_allclose(theirs.positions_xyz, drive.positions_xyz)
    check(path, PoseFileOptions(), drive)


def test_columns_by_name_and_another_clock(tmp_path: Path, drive: PoseTrajectory3D) -> None:
    path = tmp_path / "rows.csv"
    names = ["ms", "e", "n", "u", "i", "j", "k", "real"]
    q = drive.orientations_quat_wxyz[:, [1, 2, 3, 0]]
    times = np.round(1000 * (drive.timestamps - 1_700_000_000)).astype(int)
    rows = np.column_stack([times, drive.positions_xyz, q])
    text = [",".join(names), *(",".join(map(repr, row)) for row in rows.tolist())]
    path.write_text("\n".join(text))
    columns = ColumnOptions(
        stamp="ms",
        time_unit=TimeUnit.MILLISECONDS,
        position=("e", "n", "u"),
        orientation=("i", "j", "k", "real"),
    )
    check(path, PoseFileOptions(columns=columns, offset_s=1.7e9), drive)
    with pytest.raises(BagError, match="no column 'when'; there are: ms, e, n"):
        read_poses(path, PoseFileOptions(columns=ColumnOptions(stamp="when")))


def test_a_table_without_orientations(tmp_path: Path) -> None:
    path = tmp_path / "gps.csv"
    path.write_text("time,x,y,z\n1,0,0,0\n2,0,0,0\n")
    with pytest.raises(BagError, match=r"no columns of the orientation .*`bag.pose_file.columns`"):
        read_poses(path, PoseFileOptions())

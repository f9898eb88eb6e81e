"""What no reader may wait for, or read until the memory is full."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from l2m_gtsam.config import load_config
from l2m_gtsam.errors import ConfigError, L2MError
from l2m_gtsam.storage.bag_options import PoseFileOptions
from l2m_gtsam.storage.bounded import is_there, open_regular, read_content
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.cloud import read_cloud
from l2m_gtsam.storage.files import source_file
from l2m_gtsam.storage.map_file import load_map
from l2m_gtsam.storage.open_log import open_log
from l2m_gtsam.storage.pose_files import read_poses
from l2m_gtsam.storage.record_files import read_metrics, read_outcome
from tests.support.alarms import ends_within


def opened_log(path: Path) -> None:
    with open_log(path):
        pass


def poses(path: Path) -> Any:
    return read_poses(path, PoseFileOptions())


READERS: list[tuple[Callable[[Path], Any], str]] = [
    (load_config, "config.yaml"),
    (read_calibration, "calibration.yaml"),
    (read_metrics, "metrics.json"),
    (load_map, "map.npz"),
    *((read_cloud, f"cloud.{kind}") for kind in ("pcd", "ply", "npz", "las", "laz", "e57")),
    *((opened_log, f"drive.{kind}") for kind in ("bag", "mcap", "db3", "csv", "ulg")),
    (poses, "poses.txt"),
    (poses, "poses.csv"),
    (source_file, "any"),
]


@pytest.mark.parametrize(
    ("read", "name"), READERS, ids=lambda each: getattr(each, "__name__", each)
)
def test_pipes_devices_and_impossible_names(
    tmp_path: Path, read: Callable[[Path], Any], name: str
) -> None:
    os.mkfifo(tmp_path / name)
    with ends_within(10), pytest.raises(L2MError, match="a pipe; a regular file is expected"):
        read(tmp_path / name)
    zeros = tmp_path / f"zeros{Path(name).suffix}"
    zeros.symlink_to("/dev/zero")
    with ends_within(10), pytest.raises(L2MError, match="a device; a regular file is expected"):
        read(zeros)
    with pytest.raises(L2MError, match="too long"):
        read(tmp_path / ("x" * 300 + Path(name).suffix))
    with pytest.raises(L2MError, match="null byte"):
        read(tmp_path / f"a\0b{Path(name).suffix}")


def test_a_folder_of_a_bag_with_a_pipe(tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    bag.mkdir()
    os.mkfifo(bag / "metadata.yaml")
    with ends_within(10), pytest.raises(L2MError, match=r"metadata.yaml: .*a pipe"):
        opened_log(bag)


def test_a_folder_that_is_no_bag_names_what_is_in_it(tmp_path: Path) -> None:
    with pytest.raises(L2MError, match=r"without metadata.yaml; there is no log in it; accepted"):
        opened_log(tmp_path)
    (tmp_path / "front.csv").touch()
    with pytest.raises(L2MError, match=r"without metadata.yaml; a log in it is front.csv"):
        opened_log(tmp_path)
    (tmp_path / "day_2.bag").touch()
    (tmp_path / "day_1.mcap").touch()
    with pytest.raises(L2MError, match=r"without metadata.yaml; a log in it is day_1.mcap"):
        opened_log(tmp_path)


def test_an_outcome_that_is_a_pipe_counts_as_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "outcome.json")
    with ends_within(10):
        assert read_outcome(tmp_path / "outcome.json") is None


def test_sizes(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(1001))
    assert len(read_content(path, 1001)) == 1001
    with pytest.raises(ConfigError, match=r"file: larger than 0.001 MB"):
        read_content(path, 1000, ConfigError)


def test_what_is_there(tmp_path: Path) -> None:
    assert is_there(tmp_path)
    assert not is_there(tmp_path / "missing")
    with pytest.raises(OSError, match="is a folder; a regular file is expected: "):
        open_regular(tmp_path)


def test_a_folder_in_place_of_a_file_is_told_with_what_is_in_it(tmp_path: Path) -> None:
    for name in ("calibration.yaml", "report.html"):
        (tmp_path / name).touch()
    with pytest.raises(L2MError, match=r"is a folder; .*; in it: calibration.yaml, report.html$"):
        read_content(tmp_path, 1)

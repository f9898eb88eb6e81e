"""Maps and calibrations of real bags, with the example configuration."""

from pathlib import Path

import pytest

from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration
from tests.support.browsing import drawn_figures
from tests.support.command_line import l2m
from tests.support.computed_once import computed_once


@pytest.fixture(scope="module")
def optitrack(
    shared_data: Path, tmp_path_factory: pytest.TempPathFactory, repository: Path
) -> Path:
    """Folder of a map of one real run, and of the calibration of another."""
    folder = tmp_path_factory.mktemp("optitrack")
    bags, config = shared_data / "bags", repository / "configs" / "optitrack.yaml"
    survey, map_path = bags / "optitrack_run0_ros2_sqlite", folder / "map.npz"
    with computed_once():  # another container of this run is mapped elsewhere
        l2m("map", "build", survey, "--config", config, "--out", map_path)
    wanted = ("--config", config, "--out", folder / "result", "--rerun", folder / "view.rrd")
    run = l2m("calibrate", bags / "optitrack_run1_ros1.bag", "--map", map_path, *wanted)
    assert str(folder / "view.rrd") in run.out
    return folder


def test_optitrack_configuration_on_real_bags(optitrack: Path, shared_data: Path) -> None:
    map_path = optitrack / "map.npz"
    assert "sliding_gp" in l2m("map", "info", map_path).out
    l2m("map", "plot", map_path, "--out", optitrack / "map.png")
    assert (optitrack / "map.png").stat().st_size > 10_000
    assert (optitrack / "view.rrd").stat().st_size > 10_000
    result = read_calibration(optitrack / "result" / "calibration.yaml")
    assert result["imu/mag"].status is SensorStatus.SOLVED
    assert result.bag is not None
    assert result.bag.path == str(shared_data / "bags" / "optitrack_run1_ros1.bag")
    assert result.options["bag"]["poses"] == "/optitrack/pose"


def test_the_report_of_a_real_bag_has_its_figures(optitrack: Path) -> None:
    drawn = drawn_figures(optitrack / "result" / "report.html")
    assert len(drawn) == 4 + 8
    assert min(drawn) > 5

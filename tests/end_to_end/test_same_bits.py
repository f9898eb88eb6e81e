"""One seed gives the same calibration, whoever simulates and in whatever container."""

import json
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration
from tests.support.command_line import l2m, l2m_process
from tests.worlds.halls import SMALL_HALL
from tests.worlds.quick_maps import QUICK_HARMONIC

pytestmark = pytest.mark.usefixtures("without_pages")

PRIOR = {"floor_scale": 4.0, "floor_depth": 0.6, "noise": 0.1}
QUICK = {"mapping": {"model": {"harmonic": QUICK_HARMONIC | {"hyperparameters": PRIOR}}}}


def test_another_container_gives_the_same_calibration(tmp_path: Path, repository: Path) -> None:
    """Simulated again by another process, as ROS1, with the example configuration: same bits."""
    options, quick = tmp_path / "hall.yaml", tmp_path / "quick.yaml"
    options.write_text(json.dumps(SMALL_HALL | {"array": {"count": 1}}))  # JSON is YAML
    quick.write_text(json.dumps(QUICK))
    one, other = tmp_path / "one", tmp_path / "other"
    l2m_process("simulate", "--options", options, "--out", one, "--kind", "mcap")
    l2m("simulate", "--options", options, "--out", other, "--kind", "ros1")
    assert (one / "truth.yaml").read_text() == (other / "truth.yaml").read_text()

    known = ("--suite", one / "suite.yaml", "--structure", one / "structure.ply")
    field_map = ("--map", one / "map.npz")
    wanted = ("--config", quick, "--out", one / "map.npz")
    l2m("map", "build", one / "mapping_mcap", *known, *wanted)
    example = ("--config", repository / "configs" / "warehouse.yaml")
    l2m("calibrate", one / "calibration_mcap", *field_map, "--out", one)
    out = l2m("calibrate", other / "calibration_ros1.bag", *field_map, *example, "--out", other).out
    assert out.count("solved") == 1
    a, b = (read_calibration(folder / "calibration.yaml") for folder in (one, other))
    assert [each.status for each in a.sensors] == [SensorStatus.SOLVED]
    for x, y in zip(a.sensors, b.sensors, strict=True):
        np.testing.assert_array_equal(x.t_lidar_mag, y.t_lidar_mag)
        np.testing.assert_array_equal(x.covariance, y.covariance)

"""`l2m simulate` with what it only makes on request, and what is wrong with such requests."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics
from evo.core.sync import associate_trajectories
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

from l2m_gtsam.batch.simulation import simulate_bags
from l2m_gtsam.errors import MapError
from l2m_gtsam.progress import silent
from l2m_gtsam.simulate.bag_writer import BagKind
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.storage.bag import read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.inspect import inspect_bag
from l2m_gtsam.storage.yaml_file import read_yaml
from tests.support.command_line import complaint_here, l2m

CORRIDOR = {
    "corridor": {"length": 12.0},
    "lidar": {"columns": 60, "rate": 2.0},
    "odometry": {},
    "suite": {"lateral": [0.0], "heights": [0.0]},
    "array": {"count": 1},
    "mapping_sampling": {"field_rate": 2.0, "pose_rate": 2.0},
    "calibration_sampling": {"field_rate": 2.0, "pose_rate": 10.0},
    "calibration_route": {"laps": 2},
}


def options(folder: Path, **changes: object) -> Path:
    path = folder / "options.yaml"
    path.write_text(json.dumps({**CORRIDOR, **changes}))
    return path


def test_a_corridor_with_clouds_drift_and_truth(tmp_path: Path) -> None:
    out = tmp_path / "sim"
    l2m("simulate", "--options", options(tmp_path), "--kind", "mcap", "--out", out)
    bag = out / "calibration_mcap"
    listed = l2m("inspect", bag, "--wide").out
    for topic, kind in (
        ("/points", "sensor_msgs/PointCloud2"),
        ("/ground_truth", "geometry_msgs/PoseStamped"),
        ("/odometry", "nav_msgs/Odometry"),
    ):
        (line,) = [line for line in listed.splitlines() if line.startswith(f"{topic} ")]
        assert f" {kind} " in line
    odometry = read_trajectory(bag, BagOptions())
    xyzw = Rotation.from_matrix(odometry.R).as_quat()
    found = PoseTrajectory3D(odometry.p, xyzw[:, [3, 0, 1, 2]], odometry.stamp_ns * 1e-9)
    truth = file_interface.read_tum_trajectory_file(str(out / "ground_truth.tum"))
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(associate_trajectories(truth, found))
    off = np.linalg.norm(odometry.p - truth.positions_xyz, axis=1)
    assert ape.get_statistic(metrics.StatisticsType.max) == pytest.approx(off.max())
    assert 0.01 < off.max() < 1.0  # of a way of some 40 m
    told = read_yaml(out / "truth.yaml", MapError)["simulation"]
    assert told["corridor"]["length"] == 12.0
    assert told["lidar"]["beams"] == 32


def test_another_run_without_drift_leaves_no_truth_of_the_one_before(tmp_path: Path) -> None:
    out = tmp_path / "sim"
    out.mkdir()
    (out / "ground_truth.tum").write_text("of the run before")
    plain = ScenarioOptions.model_validate({**CORRIDOR, "odometry": None, "lidar": None})
    simulate_bags(out, plain, [BagKind.MCAP], silent)
    assert not (out / "ground_truth.tum").exists()
    topics = {each.topic for each in inspect_bag(out / "calibration_mcap", BagOptions()).topics}
    assert topics == {"/odometry", "/mag_00"}


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"lidar": {"beams": 0}}, "lidar.beams"),
        ({"lidar": {"sweep": 1.0}}, "`sweep` must end before the next turn"),
        ({"odometry": {"scale": 2.0}}, "odometry.scale"),
        ({"odometry": {"origin": "here"}}, "odometry.origin"),
        ({"corridor": {"width": 0.5}}, "corridor.width"),
    ],
)
def test_wrong_requests_are_named_in_one_line(
    tmp_path: Path, wrong: dict[str, object], named: str
) -> None:
    out = tmp_path / "sim"
    assert named in complaint_here(
        "simulate", "--options", options(tmp_path, **wrong), "--out", out
    )
    assert not out.exists()


def test_without_the_libraries_of_the_extra_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    line = complaint_here("simulate", "--options", options(tmp_path), "--out", tmp_path / "sim")
    assert "pip install 'l2m-gtsam[lidar]'" in line
    assert not (tmp_path / "sim").exists()

"""`l2m export` and `l2m apply` on what `l2m calibrate` wrote."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.results import SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration
from tests.bags import Entry, ros, write
from tests.end_to_end.conftest import complaint_here, l2m
from tests.end_to_end.yard import NOISE, START, STEP, Yard, make_yard, route, world

T_LIDAR_MAG = np.array([0.12, -0.08, 0.05])
TURN = Rotation.from_euler("xyz", [0.2, -0.1, 1.3])
P = np.array([[1.03, 0.01, 0], [0.01, 0.97, -0.012], [0, -0.012, 1.01]])
C = TURN.as_matrix() @ P
H = np.array([4.0, -7.0, 2.0])


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Yard:
    return make_yard(tmp_path_factory.mktemp("yard"))


@pytest.fixture(scope="module")
def field_map(yard: Yard) -> Path:
    path = yard.west.parent / "map.npz"
    l2m("map", "build", yard.west, "--config", yard.config, "--out", path)
    return path


@pytest.fixture(scope="module")
def drive(yard: Yard) -> Path:
    return written(yard.west.parent, "mcap")


def written(
    folder: Path, kind: str, name: str = "drive", seed: int = 5, offset: FloatArray = H
) -> Path:
    """Write a drive through the west with turns and tilts, and one distorted sensor."""
    make, entries = ros(kind), []
    p, rng = route(-2.8, 0.2), np.random.default_rng(seed)
    k = np.arange(len(p))
    angles = np.column_stack([0.05 * k, 0.3 * np.sin(0.31 * k), 0.3 * np.cos(0.43 * k)])
    R = Rotation.from_euler("ZYX", angles)
    field, _ = world().field_and_gradient(p + R.apply(T_LIDAR_MAG))
    readings = R.inv().apply(field) @ C.T + offset + rng.normal(0, NOISE, field.shape)
    for n, q in enumerate(R.as_quat()):
        stamp = START + n * STEP
        pose = make.pose_stamped(stamp, p[n], q)
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose))
        magnetic = make.magnetic(stamp, readings[n] * 1e-6)
        entries.append(Entry("/mag", "sensor_msgs/MagneticField", stamp, magnetic))
    return write(folder, kind, entries, name)


@pytest.fixture(scope="module")
def calibration(yard: Yard, field_map: Path, drive: Path) -> Path:
    return calibrated(yard.west.parent / "first", yard, field_map, drive, "mag")


def calibrated(folder: Path, yard: Yard, field_map: Path, bag: Path, sensor: str) -> Path:
    """Calibrate one sensor from a start near its place, and return the file; JSON is YAML."""
    folder.mkdir()
    content = json.loads(yard.config.read_text())
    content["bag"]["fields"] = [f"/{sensor}"]
    content["calibration"] = {"start": {sensor: [0.1, -0.1, 0.0]}}
    config = folder / "c.yaml"
    config.write_text(json.dumps(content))
    l2m("calibrate", bag, "--map", field_map, "--config", config, "--out", folder)
    return folder / "calibration.yaml"


def test_a_calibrated_bag_calibrates_to_nothing(
    yard: Yard, field_map: Path, drive: Path, calibration: Path, tmp_path: Path
) -> None:
    """C = I and H = 0 within the sigmas, and t as before.

    The readings are the same in other axes, with no new noise: what is found differs only by what
    a noise that is a few percent stronger along one axis changes in the weights, and in which of
    50 readings that the quick map does not explain are rejected. C and H were off by up to 0.06
    sigma, t by 0.3.
    """
    bag = tmp_path / "calibrated"
    out = l2m("apply", drive, "--calibration", calibration, "--out", bag, "--replace").out
    assert "mag: /mag/calibrated" in out
    again = calibrated(tmp_path / "second", yard, field_map, bag, "mag/calibrated")
    first = read_calibration(calibration)["mag"]
    second = read_calibration(again)["mag/calibrated"]
    assert first.status is second.status is SensorStatus.SOLVED
    assert (np.abs(second.distortion.C - np.eye(3)) < second.C_sigma).all()
    assert (np.abs(second.distortion.H) < second.H_sigma).all()
    assert (np.abs(second.t_lidar_mag - first.t_lidar_mag) < first.t_sigma).all()
    # There was something to correct, and the quick map is good to a few centimetres and percent.
    np.testing.assert_allclose(first.t_lidar_mag, T_LIDAR_MAG, rtol=0, atol=0.05)
    np.testing.assert_allclose(first.distortion.C, C, rtol=0, atol=0.03)


@pytest.mark.parametrize("name", ["ros2-launch", "urdf", "kalibr", "json", "bias-scale"])
def test_every_format_is_written(name: str, calibration: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "file"
    run = l2m("export", calibration, "--format", name, "--out", out, "--frame", "mag=imu_mag")
    assert f"written: {out}" in run.out
    assert "warning" not in run.err
    assert "imu_mag" in out.read_text()
    assert "sha256 " in out.read_text() or 'sha256"' in out.read_text()


def test_the_commands_of_the_page_run(
    calibration: Path, tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a folder with what they read, they write what they name."""
    page = (repository / "docs" / "export.md").read_text()
    (block,) = re.findall(r"```bash\n(.*?)```", page, re.DOTALL)
    shutil.copy(calibration, tmp_path / "calibration.yaml")
    (tmp_path / "robot.urdf").write_text('<robot name="r"><link name="velodyne"/></robot>')
    written(tmp_path, "ros1")
    monkeypatch.chdir(tmp_path)
    for command in block.splitlines():
        name, *arguments = shlex.split(command)
        assert name == "l2m"
        l2m(*arguments)
        assert Path(arguments[-1]).is_file()


def test_a_robot_gets_the_sensor(calibration: Path, tmp_path: Path) -> None:
    robot, out = tmp_path / "robot.urdf", tmp_path / "out.urdf"
    robot.write_text('<robot name="r">\n  <link name="top"/>\n</robot>\n')
    common = ("export", calibration, "--format", "urdf", "--into", robot)
    l2m(*common, "--lidar-frame", "top", "--out", out)
    assert '<parent link="top"/>' in out.read_text()
    assert "<joint" not in robot.read_text()
    assert "no link 'lidar' for the LiDAR" in complaint_here(*common, "--out", tmp_path / "x")
    line = complaint_here(*common, "--lidar-frame", "top", "--out", robot)
    assert "is what is read; choose another --out" in line
    assert not (tmp_path / "x").exists()


def test_bad_input(calibration: Path, drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def export(*arguments: str | Path) -> str:
        return complaint_here("export", *arguments, "--out", out)

    accepted = "accepted: ros2-launch, urdf, kalibr, json, bias-scale"
    assert accepted in export(calibration, "--format", "sdf")
    assert "accepted: SENSOR=NAME" in export(calibration, "--format", "urdf", "--frame", "mag")
    assert "no sensor 'm'; there" in export(calibration, "--format", "urdf", "--frame", "m=x")
    assert "goes with --format urdf" in export(calibration, "--format", "json", "--into", drive)
    assert "no such file" in export(tmp_path / "no.yaml", "--format", "json")
    assert "cannot be read" in export(calibration, "--format", "urdf", "--into", tmp_path / "no")
    apply = ("apply", drive, "--calibration")
    assert "no such file" in complaint_here(*apply, tmp_path / "no.yaml", "--out", out)
    assert "exists already" in complaint_here(*apply, calibration, "--out", drive)
    assert not out.exists()

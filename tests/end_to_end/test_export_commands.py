"""`l2m export` and `l2m apply` on what `l2m calibrate` wrote."""

from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.exports.formats import FORMATS
from tests.drives.yard import T_LIDAR_MAG, C, CalibratedYard, calibrated
from tests.support.command_line import complaint_here, l2m

pytestmark = pytest.mark.usefixtures("without_pages")


def test_a_calibrated_bag_calibrates_to_nothing(
    place: CalibratedYard, calibration: Path, tmp_path: Path
) -> None:
    """C = I and H = 0 within the sigmas, and t as before.

    The readings are the same in other axes, with no new noise: what is found differs only by what
    a noise that is a few percent stronger along one axis changes in the weights, and in which of
    50 readings that the quick map does not explain are rejected. C and H were off by up to 0.06
    sigma, t by 0.3.
    """
    bag = tmp_path / "calibrated"
    out = l2m("apply", place.drive, "--calibration", calibration, "--out", bag, "--replace").out
    assert "mag: /mag/calibrated" in out
    again = calibrated(tmp_path / "second", place.yard, place.map, bag, "mag/calibrated")
    first = read_calibration(calibration)["mag"]
    second = read_calibration(again)["mag/calibrated"]
    assert first.status is second.status is SensorStatus.SOLVED
    assert (np.abs(second.distortion.C - np.eye(3)) < second.C_sigma).all()
    assert (np.abs(second.distortion.H) < second.H_sigma).all()
    assert (np.abs(second.t_lidar_mag - first.t_lidar_mag) < first.t_sigma).all()
    # There was something to correct, and the quick map is good to a few centimetres and percent.
    np.testing.assert_allclose(first.t_lidar_mag, T_LIDAR_MAG, rtol=0, atol=0.05)
    np.testing.assert_allclose(first.distortion.C, C, rtol=0, atol=0.03)


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_every_format_is_written(name: str, calibration: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "file"
    run = l2m("export", calibration, "--format", name, "--out", out, "--frame", "mag=imu_mag")
    assert f"written: {out}" in run.out
    (line,) = run.err.splitlines()  # the quick map explains little
    assert line.startswith(f"l2m: warning: {calibration}: its verdict is WARN: Of the map: ")
    assert "imu_mag" in out.read_text()
    assert "sha256 " in out.read_text() or 'sha256"' in out.read_text()


def test_a_robot_gets_the_sensor(calibration: Path, tmp_path: Path) -> None:
    robot, out = tmp_path / "robot.urdf", tmp_path / "out.urdf"
    robot.write_text('<robot name="r">\n  <link name="top"/>\n</robot>\n')
    common = ("export", calibration, "--format", "urdf", "--into", robot)
    l2m(*common, "--lidar-frame", "top", "--out", out)
    assert '<parent link="top"/>' in out.read_text()
    assert "<joint" not in robot.read_text()
    assert "no link 'lidar' for the LiDAR" in complaint_here(*common, "--out", tmp_path / "x")
    line = complaint_here(*common, "--lidar-frame", "top", "--out", robot)
    assert "would be overwritten, but is read; choose another --out" in line
    assert not (tmp_path / "x").exists()


def test_bad_input(place: CalibratedYard, calibration: Path, tmp_path: Path) -> None:
    out, drive = tmp_path / "out", place.drive

    def export(*arguments: str | Path) -> str:
        return complaint_here("export", *arguments, "--out", out)

    accepted = "accepted: ros2-launch, urdf, kalibr, json, bias-scale"
    assert accepted in export(calibration, "--format", "sdf")
    assert "accepted: SENSOR=NAME" in export(calibration, "--format", "urdf", "--frame", "mag")
    assert "no sensor 'm'; there" in export(calibration, "--format", "urdf", "--frame", "m=x")
    assert "goes with --format urdf" in export(calibration, "--format", "json", "--into", drive)
    assert "no such file" in export(tmp_path / "no.yaml", "--format", "json")
    assert "no such file" in export(calibration, "--format", "urdf", "--into", tmp_path / "no")
    apply = ("apply", drive, "--calibration")
    assert "no such file" in complaint_here(*apply, tmp_path / "no.yaml", "--out", out)
    assert "exists already" in complaint_here(*apply, calibration, "--out", drive)
    assert not out.exists()

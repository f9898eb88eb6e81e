"""`l2m slam --online` on a bag: what it writes, and what is left when it is killed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.batch import online_slam
from l2m_gtsam.errors import LidarError
from l2m_gtsam.storage.bag import read_trajectory
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.listed_sensors import read_sensors
from l2m_gtsam.storage.pose_files import read_tum
from tests.drives.yard import CalibratedYard
from tests.support.command_line import complaint_here, l2m

pytestmark = pytest.mark.usefixtures("without_pages")

PROGRAM = [sys.executable, "-c", "from l2m_gtsam.cli.app import main; main()"]
TIMEOUT_S = 120


@pytest.fixture(scope="module")
def command(place: CalibratedYard, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A drive in the map of the yard, whose state is saved every five seconds."""
    content = json.loads(place.yard.config.read_text())
    # The meander turns within one pose: no jump, but the motion of this vehicle.
    slam = {"jumps": {"position_m": 1.0}, "online": {"save_every_s": 5}, "calibration": "refined"}
    content["slam"] = {"key_poses": {"distance_m": 0.3, "angle_deg": 30}, **slam}
    config = tmp_path_factory.mktemp("online") / "slam.yaml"
    config.write_text(json.dumps(content))
    files = ["--calibration", place.calibration, "--config", config, "--map", place.map]
    return [str(each) for each in ("slam", place.drive, "--online", *files)]


@pytest.fixture(scope="module")
def whole(command: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    run = l2m(*command, "--out", out)
    assert "key poses on line" in run.out
    return out


def test_poses_come_with_covariances(whole: Path) -> None:
    lines = [json.loads(line) for line in (whole / "online.jsonl").read_text().splitlines()]
    poses = [each for each in lines if "p" in each]
    trajectory = read_tum(whole / "trajectory.tum")
    assert len(poses) == len(trajectory)
    assert np.all(np.linalg.eigvalsh([each["covariance"] for each in poses]) > 0)
    assert {each.name for each in whole.iterdir()} == {
        "online.jsonl", "refined.yaml", "state.npz", "trajectory.tum",
    }  # fmt: skip


def test_the_refined_calibration_is_written_and_read(
    command: list[str], whole: Path, place: CalibratedYard
) -> None:
    """Where a calibration is; it is not written over while it is what is read."""
    before, after = (read_sensors(each) for each in (place.calibration, whole / "refined.yaml"))
    for was, now in zip(before.sensors, after.sensors, strict=True):
        assert now.sensor == was.sensor
        assert np.trace(now.covariance[12:, 12:]) < np.trace(was.covariance[12:, 12:])
    again = [
        str(whole / "refined.yaml") if each == str(place.calibration) else each for each in command
    ]
    assert "choose another --out" in complaint_here(*again, "--out", whole)


def test_killed_it_goes_on_from_its_state(
    command: list[str], whole: Path, place: CalibratedYard, tmp_path: Path
) -> None:
    """Killed as soon as a state is there: resumed, all key poses are there, once."""
    out = tmp_path / "out"
    run = subprocess.Popen([*PROGRAM, *command, "--out", str(out)], stderr=subprocess.DEVNULL)
    late = time.monotonic() + TIMEOUT_S
    while not (out / "state.npz").exists() and time.monotonic() < late:
        time.sleep(0.01)  # between looks: the process shows by a file that it writes
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    assert not (out / "trajectory.tum").exists()
    l2m(*command, "--out", out, "--resume")
    found, expected = (read_tum(each / "trajectory.tum") for each in (out, whole))
    np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)
    assert "resumed" in (out / "online.jsonl").read_text()
    # Until the state was saved they are the same. After it they are as near to the true poses,
    # which odometry has in this drive; the field of the yard says little of where they are.
    np.testing.assert_array_equal(found.p[:10], expected.p[:10])
    truth = read_trajectory(place.drive, BagOptions(poses="/pose"))
    rows = np.searchsorted(truth.stamp_ns, found.stamp_ns)
    errors = [np.sqrt(np.mean((each.p - truth.p[rows]) ** 2)) for each in (found, expected)]
    assert errors[0] < 1.5 * errors[1]


def test_what_cannot_be_resumed_is_one_line(command: list[str], tmp_path: Path) -> None:
    assert "begin without --resume" in complaint_here(*command, "--out", tmp_path, "--resume")
    without = [each for each in command if each != "--online"]
    assert "give both" in complaint_here(*without, "--out", tmp_path, "--resume")
    (tmp_path / "state.npz").write_bytes(b"PK\x05\x06" + bytes(18))
    assert "begin without --resume" in complaint_here(*command, "--out", tmp_path, "--resume")


def test_without_the_extra_clouds_take_no_part_and_it_is_said(
    place: CalibratedYard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a map a drive goes on by magnetometers alone, as off line."""

    def missing(_: str) -> None:
        raise LidarError("poses from point clouds need small_gicp: pip install it")

    monkeypatch.setattr(online_slam, "has_clouds", lambda _: True)
    monkeypatch.setattr(online_slam, "library", missing)
    content = json.loads(place.yard.config.read_text())
    content["slam"] = {"key_poses": {"distance_m": 0.5, "angle_deg": 30}}
    config, out = tmp_path / "slam.yaml", tmp_path / "out"
    config.write_text(json.dumps(content))
    arguments = ("--calibration", place.calibration, "--config", config, "--out", out)
    l2m("slam", place.drive, "--online", *arguments)
    assert "point clouds take no part: poses from" in (out / "online.jsonl").read_text()
    assert not (out / "refined.yaml").exists()

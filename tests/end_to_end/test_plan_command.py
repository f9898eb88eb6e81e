"""`l2m plan`, with and without magnetometers in the bag."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from tests.drives.bags import Entry, ros, write
from tests.support.command_line import complaint_here, l2m
from tests.worlds.yard import START, STEP, Yard, route


def poses_only(folder: Path, places: FloatArray) -> Path:
    """Write a drive of a vehicle that has no magnetometer yet: one heading, no tilt."""
    make, entries = ros("mcap"), []
    for k, p in enumerate(places):
        pose = make.pose_stamped(START + k * STEP, p, Rotation.identity().as_quat())
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", START + k * STEP, pose))
    return write(folder, "mcap", entries, "poses")


def test_the_sensors_of_a_bag(yard: Yard, field_map: Path) -> None:
    run = l2m("plan", yard.west, "--map", field_map, "--config", yard.config)
    out = " ".join(run.out.split())
    (row,) = [line for line in run.out.splitlines() if line.startswith("mag ")]
    assert "  0.000 0.000 0.000  " in row
    for motion in ("heave", "roll", "pitch", "turn round", "other way round", "a loop of 0.5 m"):
        assert motion in out
    assert "helps mag most: " in out
    assert "sigmas include the map's errors" in out
    assert "l2m: warning: " in run.err


def test_a_bag_of_poses_alone(yard: Yard, field_map: Path, tmp_path: Path) -> None:
    bag = poses_only(tmp_path, route(-2.5, -1.5))
    common = ("plan", bag, "--map", field_map, "--config", yard.config)
    out = l2m(*common, "--at", "0.1,0,-0.05", "--at", "0,0,0").out
    assert "at 0.1,0,-0.05" in out
    assert "at 0,0,0" in out


def test_a_parked_vehicle(yard: Yard, field_map: Path, tmp_path: Path) -> None:
    """Nothing is determined: exit code 0, no number, the reason and what to do about it."""
    bag = poses_only(tmp_path, np.tile([-1.0, 0.5, 0.4], (60, 1)))
    out = l2m("plan", bag, "--map", field_map, "--config", yard.config).out
    assert "at 0,0,0" in out
    assert "everything: the vehicle did not move (0.00 m, 0.0 deg)" in " ".join(out.split())
    assert "- - - - - - - - - " in " ".join(out.split())  # of t, H and rotation
    assert "(15 parameters not determined; with it " in out


@pytest.mark.parametrize("at", ["1,2", "a,b,c", "1,2,nan", ""])
def test_a_place_that_is_none(yard: Yard, at: str, tmp_path: Path) -> None:
    line = complaint_here("plan", yard.west, "--map", tmp_path / "map.npz", "--at", at)
    assert "accepted: three numbers, x,y,z in metres" in line


def test_bad_input(yard: Yard, field_map: Path, tmp_path: Path) -> None:
    def plan(bag: Path, field_map: Path, config: Path = yard.config) -> str:
        return complaint_here("plan", bag, "--map", field_map, "--config", config)

    assert "nowhere: no such file" in plan(tmp_path / "nowhere", field_map)
    assert "no such map file" in plan(yard.west, tmp_path / "nowhere.npz")
    away = poses_only(tmp_path, route(47.5, 48.5))
    line = plan(away, field_map)
    assert "the map does not cover the drive" in line
    assert "is it another place or another map frame?" in line
    far = ("--map", field_map, "--config", yard.config, "--at", "100,0,0")
    line = complaint_here("plan", yard.west, *far)
    assert "covers the drive" in line
    assert "but no place of a sensor: at 100,0,0 (100, 0, 0)" in line
    config = tmp_path / "c.yaml"
    config.write_text("bag: {poses: /pose}\ncalibration: {start: {mag_9: [0, 0, 0]}}\n")
    assert "no sensor named 'mag_9'; the recording has mag" in plan(yard.west, field_map, config)
    config.write_text("plan: {rate: 3}\n")
    line = plan(yard.west, field_map, config)
    assert "unknown key 'plan.rate'; accepted here: motion, noise_ut, rate_hz" in line

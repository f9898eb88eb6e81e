"""`l2m map suite` on a real bag, and on what it cannot work with."""

import json
from pathlib import Path

from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.known_sensors import read_known_sensors
from tests.drives.begun import begin
from tests.support.command_line import complaint_here, l2m
from tests.worlds.quick_maps import QUICK_HARMONIC

# Of a drive of 104; 38 to 41 of them determine no place, and what is found depends on rounding.
SECONDS = 60.0
NAMED = {"fields": ["/imu/mag"], "poses": "/optitrack/pose"}
QUICK = {"sync": {"thin_distance_m": 0.05}, "windows": 1, "readings": 800, "modes": 120}


def test_a_suite_is_calibrated_and_maps(shared_data: Path, tmp_path: Path) -> None:
    """A handheld sensor that is 20 ms late; what it is found to be is what the map is made with."""
    bag = begin(shared_data / "bags" / "optitrack_run0_ros1.bag", tmp_path / "begin.bag", SECONDS)
    config, out = tmp_path / "quick.json", tmp_path / "made" / "suite.yaml"
    prior = {"floor_scale": 7.0, "floor_depth": 0.55, "noise": 0.12}
    mapping = {"suite": QUICK, "model": {"harmonic": QUICK_HARMONIC | {"hyperparameters": prior}}}
    config.write_text(json.dumps({"bag": NAMED, "mapping": mapping}))
    run = l2m("map", "suite", bag, "--config", config, "--out", out)
    assert "imu/mag" in run.out
    found = read_calibration(out)
    (sensor,) = found.sensors
    assert found.bag is not None
    assert found.bag.path == str(bag)
    assert found.options["mapping"]["suite"]["windows"] == 1
    assert sensor.time_offset is not None
    assert -0.025 < sensor.time_offset.seconds < -0.015
    known = read_known_sensors(out)["imu/mag"]
    assert known.time_offset == sensor.time_offset.seconds
    field_map = tmp_path / "map.npz"
    l2m("map", "build", bag, "--suite", out, "--config", config, "--out", field_map)
    # The errors that the suite states went into the file, and come out of it.
    assert "their errors are in the sigmas" in l2m("map", "info", field_map).out


def test_a_suite_that_does_not_settle_is_not_written(shared_data: Path, tmp_path: Path) -> None:
    """A file of it is what `l2m map build` would refuse."""
    bag = begin(shared_data / "bags" / "optitrack_run0_ros1.bag", tmp_path / "begin.bag", SECONDS)
    config, out = tmp_path / "one.json", tmp_path / "suite.yaml"
    suite = QUICK | {"rounds": 1}
    config.write_text(json.dumps({"bag": NAMED, "mapping": {"suite": suite}}))
    told = complaint_here("map", "suite", bag, "--config", config, "--out", out)
    assert (
        "no sensor of the suite is solved, nothing is written: still moving after 1 round" in told
    )
    assert "mapping.suite.rounds, or give what is known with --suite" in told
    assert not out.exists()


def test_what_cannot_be_done_is_said_in_one_line(shared_data: Path, tmp_path: Path) -> None:
    bag, out = shared_data / "bags" / "optitrack_run0_ros1.bag", tmp_path / "suite.yaml"
    assert "the name must end in .yaml" in complaint_here(
        "map", "suite", bag, "--out", tmp_path / "suite.npz"
    )
    assert "is listed twice" in complaint_here("map", "suite", bag, bag, "--out", out)
    missing = complaint_here("map", "suite", tmp_path / "no.bag", "--out", out)
    assert "no.bag" in missing
    assert not out.exists()

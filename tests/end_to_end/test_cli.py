"""The command line on good and bad input, as a user meets it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from l2m_gtsam.errors import BagError
from l2m_gtsam.records.calibration import SensorStatus, Uncertainty
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.known_sensors import read_known_sensors
from l2m_gtsam.storage.record_files import read_metrics
from tests.drives.bags import Entry, ros, write
from tests.support.browsing import drawn_figures
from tests.support.command_line import Demo, complaint_here, ended, l2m, l2m_process, one_line


def test_help_loads_nothing_heavy() -> None:
    """It answers within half a second only as long as the mathematics stays unloaded."""
    heavy = {"numpy", "scipy", "gtsam", "rosbags", "matplotlib", "magpylib", "pydantic"} | {
        "jinja2"
    }
    code = (
        "import sys; sys.argv = ['l2m', '--help']\n"
        "from l2m_gtsam.cli.app import main\n"
        "try:\n    main()\n"
        f"except SystemExit:\n    print('loaded:', sorted({heavy!r} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(name in run.stdout for name in ("inspect", "simulate", "calibrate", "demo", "map"))
    assert "loaded: []" in run.stdout


def test_demo_ends_with_truth_and_estimate(demo: Demo) -> None:
    """Both sensors of a small hall: 200 readings and a map of one rack give centimetres."""
    check_demo(demo, 2, t_m=0.03, C=0.03, H_ut=1.0)


@pytest.mark.study
def test_the_demonstration_of_twelve_sensors(tmp_path: Path) -> None:
    """With its defaults: errors were 1.2, 0.9 and 0.9 mm rms.

    8 mm leave room for platforms whose rounding leads to other sources and tiles.
    """
    made = Demo(tmp_path, l2m_process("demo", "--out", tmp_path).out)
    check_demo(made, 12, t_m=0.008, C=0.02, H_ut=0.3)


def check_demo(demo: Demo, sensors: int, t_m: float, C: float, H_ut: float) -> None:
    """All sensors are solved and told, with errors below these limits, and there is a picture."""
    table, verdict = demo.out.split("verdict: ")  # which may name sensors once more
    assert table.count("mag_") == sensors
    assert "times their sigmas" in table
    assert verdict.startswith(("PASS", "WARN"))
    result = read_calibration(demo.folder / "calibration.yaml")
    truth = read_known_sensors(demo.folder / "truth.yaml")
    assert [s.status for s in result.sensors] == [SensorStatus.SOLVED] * sensors
    for sensor in result.sensors:
        true = truth[sensor.sensor]
        assert np.abs(sensor.t_lidar_mag - true.t_lidar_mag).max() < t_m
        assert np.abs(sensor.distortion.C - true.distortion.C).max() < C
        assert np.abs(sensor.distortion.H - true.distortion.H).max() < H_ut
    with Image.open(demo.folder / "overview.png") as picture:
        assert picture.width > 1000


def test_the_report_of_a_hall_has_its_figures(demo: Demo) -> None:
    drawn = drawn_figures(demo.folder / "report.html")
    assert len(drawn) == 4 + 8 * 2  # of vehicle and map, and of each sensor
    assert min(drawn) > 5


def test_residuals_and_readings_are_the_same_everywhere(demo: Demo) -> None:
    """In terminal, file, metrics and page, although the solve counts errors of map and poses."""
    result = read_calibration(demo.folder / "calibration.yaml")
    metrics = read_metrics(demo.folder / "metrics.json")
    page = (demo.folder / "report.html").read_text()
    assert result.uncertainty is Uncertainty.FULL
    for sensor in result.sensors:
        left, found = sensor.residuals, metrics.get(sensor.sensor)
        assert left is not None
        assert found is not None
        # the last step moves clocks by up to 0.1 ms after the poses were taken
        np.testing.assert_allclose(found.fit.rms, left.rms_axes, rtol=5e-3)
        assert left.rms == pytest.approx(np.linalg.norm(left.rms_axes))
        axes = ", ".join(f"{each:.3f}" for each in left.rms_axes)
        assert f"rms {axes} µT along x, y, z, {left.rms:.3f} µT of the length" in page
        assert f"{left.readings:,} readings (effective" in page


def test_inspect_shows_every_topic(demo: Demo) -> None:
    out = l2m("inspect", demo.drive).out
    assert out.count("magnetic readings") == 2
    assert "nav_msgs/Odometry" in out
    assert "poses (the only topic with poses)" in out


def test_inspect_escapes_what_a_bag_says(tmp_path: Path) -> None:
    make = ros("ros1")
    reading = make.magnetic(1, [2e-5, 0, -4e-5], "[bold red]frame[/]")
    entry = Entry("/[link=x]mag", "sensor_msgs/MagneticField", 1, reading)
    run = ended("inspect", write(tmp_path, "ros1", [entry]))
    assert run.code == 1  # no poses
    assert "[link=x]mag" in run.out
    assert "[bold red]frame[/]" in run.out


def test_bad_bags_and_topics(demo: Demo, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def calibrate(bag: Path, *more: str | Path) -> str:
        return complaint_here("calibrate", bag, "--map", demo.map, "--out", out, *more)

    assert "nowhere.bag: no such file" in calibrate(tmp_path / "nowhere.bag")
    truncated = tmp_path / "cut.mcap"
    whole = next(demo.drive.glob("*.mcap")).read_bytes()
    truncated.write_bytes(whole[: len(whole) // 2])
    assert "truncated" in calibrate(truncated)
    config = tmp_path / "c.yaml"
    config.write_text("bag: {fields: [/compass]}\n")
    line = calibrate(demo.drive, "--config", config)
    assert "matches '/compass'; there are: /mag_00" in line
    config.write_text("bag: {poses: /mag_00}\n")
    assert "is of type sensor_msgs/msg/MagneticField" in calibrate(demo.drive, "--config", config)
    config.write_text("bag: {units: gauss}\ncalibration: {solve: {optimiser: gn}}\n")
    assert "unknown key 'calibration.solve.optimiser'" in calibrate(demo.drive, "--config", config)
    assert not out.exists()


def test_bad_maps(demo: Demo, tmp_path: Path) -> None:
    out = tmp_path / "out"
    damaged, foreign = tmp_path / "damaged.npz", tmp_path / "foreign.npz"
    data = bytearray(demo.map.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged.write_bytes(data)
    np.savez(foreign, a=np.eye(3))
    for path, reason in (
        (damaged, "damaged"),
        (foreign, "not a map file"),
        (tmp_path / "nowhere.npz", "no such"),
    ):
        for line in (
            complaint_here("calibrate", demo.drive, "--map", path, "--out", out),
            complaint_here("map", "info", path),
        ):
            assert reason in line
            assert str(path) in line
    assert not out.exists()


def test_a_map_of_another_place(demo: Demo, shared_data: Path, tmp_path: Path) -> None:
    bag = shared_data / "bags" / "optitrack_run1_ros1.bag"
    line = complaint_here("calibrate", bag, "--map", demo.map, "--out", tmp_path / "out")
    assert "map.npz does not cover the drive" in line
    assert not (tmp_path / "out").exists()


def test_wrong_units_are_refused_and_overridden(demo: Demo, tmp_path: Path) -> None:
    make = ros("mcap")
    entries = []
    for k in range(50):
        stamp = 1_700_000_000_000_000_000 + k * 100_000_000
        pose = make.pose_stamped(stamp, [0.1 * k, 0, 0], [0, 0, 0, 1])
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose))
        reading = make.magnetic(stamp, [0.2 + 0.001 * k, 0.1, -0.4])
        entries.append(Entry("/mag", "sensor_msgs/MagneticField", stamp, reading))
    bag = write(tmp_path, "mcap", entries)
    line = complaint_here("map", "build", bag, "--out", tmp_path / "m.npz")
    assert "likely gauss: set `bag.units: gauss`" in line
    assert not (tmp_path / "m.npz").exists()


def test_suite_without_the_sensor(demo: Demo, tmp_path: Path) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text("sensors: {other: {t_lidar_mag: [0, 0, 0]}}\n")
    mapping = demo.folder / "mapping_mcap"
    line = complaint_here("map", "build", mapping, "--suite", suite, "--out", tmp_path / "m.npz")
    assert "does not list the sensor 'suite_00'; it lists other" in line


def test_an_output_that_cannot_be_written(demo: Demo, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    line = complaint_here("calibrate", demo.drive, "--map", demo.map, "--out", tmp_path / "file")
    assert "is a file; a folder is needed there" in line
    assert (tmp_path / "file").read_text() == "in the way"


def test_a_process_ends_with_one_line(tmp_path: Path) -> None:
    run = l2m_process("inspect", tmp_path / "nowhere.bag", fails=True)
    assert "nowhere.bag: no such file" in one_line(run)


@pytest.mark.parametrize(
    ("command", "complaint"),
    [
        (["slam", "a.mcap"], "missing option '--calibration' (`l2m slam --help` shows"),
        (["calibrate", "--mapp"], "no such option: --mapp"),
        (["map", "bild"], "no such command 'bild'. Did you mean 'build'? (`l2m map --help`"),
        (["simulate", "--out", "s", "--seed", "a"], "invalid value for '--seed'"),
    ],
)
def test_a_wrong_command_line_is_told_in_one_line(command: list[str], complaint: str) -> None:
    assert complaint in complaint_here(*command)


@pytest.mark.parametrize("group", [[], ["map"]])
def test_a_group_without_a_command_shows_its_help(group: list[str]) -> None:
    run = ended(*group)
    assert (run.code, run.err) == (2, "")
    assert "Commands" in run.out


def test_options_in_the_place_of_a_bag(tmp_path: Path) -> None:
    (tmp_path / "options.yaml").write_text("seed: 1")
    line = complaint_here("map", "build", tmp_path / "options.yaml", "--out", tmp_path / "m.npz")
    assert "options.yaml: not a bag, by its name; accepted: a ROS1 .bag" in line


def test_debug_leaves_an_error_to_python(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="no such file"):
        ended("inspect", tmp_path / "nowhere.bag", "--debug")


def test_options_of_a_simulation_that_are_not_understood(tmp_path: Path) -> None:
    options, out = tmp_path / "hall.yaml", tmp_path / "s"
    options.write_text("floor_plan: {racks: 2}")
    line = complaint_here("simulate", "--out", out, "--options", options)
    assert "unknown key 'floor_plan.racks'; accepted here: blocks, cross_aisle" in line
    options.write_text("floor_plan: {width: 5}")
    assert "6 rows of 2.4 m leave aisles of" in complaint_here(
        "simulate", "--out", out, "--options", options
    )
    assert not out.exists()


@pytest.mark.parametrize("kind", ["ros3", ""])
def test_an_unknown_bag_kind(tmp_path: Path, kind: str) -> None:
    line = complaint_here("simulate", "--out", tmp_path / "s", "--kind", kind)
    assert "accepted: ros1, sqlite3, mcap" in line

"""A mapping bag with point clouds, and a drive that has no poses but those of its clouds."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.batch.files import SavedMap
from l2m_gtsam.batch.scan_poses import read_drive_on, read_drive_or_follow
from l2m_gtsam.batch.simulation import simulate_bags
from l2m_gtsam.config import Config, load_config
from l2m_gtsam.progress import silent
from l2m_gtsam.simulate.bag_writer import BagKind
from l2m_gtsam.simulate.scenario import Scenario, ScenarioOptions
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.map_file import load_map, save_map
from l2m_gtsam.storage.record_files import read_slam
from tests.drives.begun import begin, without
from tests.drives.calibrations import calibration, sensor
from tests.support.command_line import complaint_here, l2m
from tests.worlds.halls import SMALL_HALL
from tests.worlds.quick_maps import QUICK_HARMONIC

pytestmark = pytest.mark.usefixtures("without_pages")

# With a lidar of few columns, which a driver has freed of motion.
HALL = SMALL_HALL | {"array": {"count": 1}, "lidar": {"rate": 2.5, "columns": 120}}
SOME = 20.0  # seconds of a drive, 10 m with fifty scans
PRIOR = {"floor_scale": 4.0, "floor_depth": 0.6, "noise": 0.1}


@dataclass(frozen=True)
class Scanned:
    """What lies on disk, and the truth.

    Attributes
    ----------
    mapping, drive
        Bags with point clouds; that of the drive has no poses.
    map
        A map with the cloud of the mapping bag.
    config, nowhere
        Configurations, with and without the start of the drive.
    scenario
        The truth.
    """

    mapping: Path
    drive: Path
    map: Path
    config: Path
    nowhere: Path
    scenario: Scenario


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Scanned:
    folder = tmp_path_factory.mktemp("scanned")
    options = ScenarioOptions.model_validate(HALL)
    scenario = simulate_bags(folder, options, [BagKind.ROS1], silent)
    harmonic = QUICK_HARMONIC | {"hyperparameters": PRIOR}
    start = scenario.calibration.recording.trajectory.p[0] + [0.3, -0.2, 0.1]
    mapping = {"model": {"harmonic": harmonic}}
    # Starts are known: looking for them is tested elsewhere.
    places = {each.sensor: (each.t_lidar_mag + 0.05).tolist() for each in scenario.truth}
    calibrating = {"solve": {"uncertainty": "independent"}, "start": places}
    common = {"mapping": mapping, "calibration": calibrating}
    config, nowhere = folder / "config.yaml", folder / "nowhere.yaml"
    config.write_text(json.dumps(common | {"lidar": {"start": {"position": start.tolist()}}}))
    nowhere.write_text(json.dumps(common | {"lidar": {"search": {"tried": 8}}}))
    path, bag = folder / "map.npz", folder / "mapping_ros1.bag"
    suite = ("--suite", folder / "suite.yaml")
    l2m("map", "build", bag, *suite, "--lidar", "--config", config, "--out", path)
    drive = without("/odometry", folder / "calibration_ros1.bag", folder / "drive.bag")
    return Scanned(bag, drive, path, config, nowhere, scenario)


def test_the_cloud_is_saved_with_the_map(hall: Scanned) -> None:
    lidar = load_map(hall.map).lidar
    assert lidar is not None
    assert 5_000 < len(lidar.points) < 200_000
    # Walls are where they are built, as far as 3 mm noise of the mapping poses goes.
    outer = np.array([lidar.points.min(axis=0), lidar.points.max(axis=0)])
    assert np.all(np.ptp(outer, axis=0)[:2] < [11.5, 6.9])
    assert "cloud of scans" in l2m("map", "info", hall.map).out


def test_poses_of_a_drive_come_from_its_clouds(hall: Scanned, tmp_path: Path) -> None:
    """Errors of millimetres, no larger than their sigmas say."""
    saved, config = SavedMap.read(hall.map), load_config(hall.config)
    drive = begin(hall.drive, tmp_path / "begin.bag", seconds=SOME)
    found = read_drive_on(saved, drive, config, silent)
    assert "poses are those of its point clouds" in found.notes[0]
    trajectory = found.trajectory
    assert trajectory.frame == "map"
    true = hall.scenario.calibration.motion.at(trajectory.stamp_ns)
    error = np.einsum("nji,nj->ni", trajectory.R, true.p - trajectory.p)
    # Range noise of 10 mm over 1,500 points; 3 mm noise of the mapping poses, smoothed.
    assert np.sqrt(np.mean(error**2)) < 0.003
    assert trajectory.covariance is not None
    variance = np.diagonal(trajectory.covariance, axis1=1, axis2=2)[:, 3:]
    assert np.mean(error**2 / variance) < 1.5


def test_where_there_is_no_map_clouds_give_odometry(hall: Scanned, tmp_path: Path) -> None:
    short = begin(hall.drive, tmp_path / "b.bag", seconds=6.0)
    found = read_drive_or_follow(short, Config(), silent)
    assert "odometry by its point clouds" in found.notes[0]
    assert (found.trajectory.frame, len(found.series)) == ("odom", 1)
    true = hall.scenario.calibration.motion.at(found.trajectory.stamp_ns)
    way = np.einsum("ji,nj->ni", true.R[0], true.p - true.p[0])
    assert np.linalg.norm(way[-1]) > 1.0
    # Scans of 1,500 points, some of them 1 m from their key scan: a centimetre.
    assert np.linalg.norm(found.trajectory.p - way, axis=1).max() < 0.015
    told = l2m("inspect", short).out
    assert "poses where there are no others" in told
    assert "gives poses to its point clouds" in told


def test_a_bag_without_odometry_is_calibrated(hall: Scanned, tmp_path: Path) -> None:
    run = l2m(
        "calibrate", hall.drive, "--map", hall.map, "--config", hall.config, "--out", tmp_path
    )
    assert "poses are those of its point clouds" in run.out
    result = read_calibration(tmp_path / "calibration.yaml")
    assert "poses are those of its point clouds" in result.notes[0]
    truth = {each.sensor: each for each in hall.scenario.truth}
    for found in result.sensors:
        true = truth[found.sensor]
        # A coarse map of a small hall, 200 readings: centimetres, as with odometry.
        assert np.linalg.norm(found.t_lidar_mag - true.t_lidar_mag) < 0.04
        assert np.abs(found.distortion.H - true.distortion.H).max() < 1.0


@pytest.fixture(scope="module")
def known(hall: Scanned) -> Path:
    path = hall.map.parent / "known.yaml"
    entries = [
        sensor(
            each.sensor,
            t_lidar_mag=each.t_lidar_mag,
            distortion=each.distortion,
            covariance=1e-6 * np.eye(15),
            noise=0.1,
            time_offset=None,
        )
        for each in hall.scenario.truth
    ]
    write_calibration(path, calibration(*entries))
    return path


def test_clouds_take_part_where_a_drive_has_odometry(
    hall: Scanned, known: Path, tmp_path: Path
) -> None:
    bag, config = tmp_path / "begin.bag", tmp_path / "slam.yaml"
    begin(hall.drive.parent / "calibration_ros1.bag", bag, seconds=SOME)
    arguments = ("slam", bag, "--map", hall.map, "--calibration", known, "--config", config)
    key_poses = {"distance_m": 0.5, "readings": 2}
    config.write_text(json.dumps({"slam": {"key_poses": key_poses}}))
    out = tmp_path / "out"
    assert "loops counted" in l2m(*arguments, "--out", out).out
    record = read_slam(out / "slam.json")
    assert record.scans is not None
    # A fix for each half a metre; all of them fit odometry, which has 3 mm noise here.
    assert record.scans.fixes > 0.6 * record.drift.way_m / 0.5
    assert record.scans.rejected == 0
    assert record.scans.chi2_per_dof < 2
    config.write_text(json.dumps({"slam": {"key_poses": key_poses, "scans": "ignored"}}))
    assert "loops counted" not in l2m(*arguments, "--out", out).out
    assert read_slam(out / "slam.json").scans is None


def test_clouds_that_fit_nowhere_do_not_stop_a_drive(
    hall: Scanned, known: Path, tmp_path: Path
) -> None:
    """The map's cloud is of another hall: the magnetometers go on alone, and it is told."""
    bag, elsewhere = tmp_path / "begin.bag", tmp_path / "elsewhere.npz"
    begin(hall.drive.parent / "calibration_ros1.bag", bag, seconds=SOME)
    state = load_map(hall.map)
    assert state.lidar is not None
    moved = replace(state.lidar, points=state.lidar.points * [0.6, 1.7, 1.3])
    save_map(elsewhere, replace(state, lidar=moved))
    config = tmp_path / "slam.yaml"
    config.write_text(json.dumps({"slam": {"key_poses": {"distance_m": 0.5, "readings": 2}}}))
    arguments = ("slam", bag, "--map", elsewhere, "--calibration", known, "--config", config)
    told = l2m(*arguments, "--out", tmp_path / "out").out
    assert "point clouds take no part: the first scan does not fit the map's cloud" in told
    assert read_slam(tmp_path / "out" / "slam.json").scans is None


def test_a_hall_that_looks_the_same_from_both_ends(hall: Scanned, tmp_path: Path) -> None:
    """Without a start it is looked for, and found twice."""
    told = complaint_here(
        "calibrate",
        hall.drive,
        "--map",
        hall.map,
        "--config",
        hall.nowhere,
        "--out",
        tmp_path / "x",
    )
    assert "fits at several places" in told
    assert "lidar.start" in told
    assert not (tmp_path / "x").exists()


def test_a_map_without_a_cloud_is_told(hall: Scanned, tmp_path: Path) -> None:
    plain = tmp_path / "plain.npz"
    save_map(plain, replace(load_map(hall.map), lidar=None))
    told = complaint_here(
        "calibrate", hall.drive, "--map", plain, "--config", hall.config, "--out", tmp_path / "x"
    )
    assert "`l2m map build --lidar`" in told


def test_a_mapping_bag_without_clouds_is_told(hall: Scanned, tmp_path: Path) -> None:
    bare = without("/points", hall.mapping, tmp_path / "bare.bag")
    told = complaint_here("map", "build", bare, "--lidar", "--out", tmp_path / "map.npz")
    assert "no topic of type sensor_msgs/msg/PointCloud2" in told
    assert not (tmp_path / "map.npz").exists()

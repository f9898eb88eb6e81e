"""Real data that others recorded: a handheld magnetometer under a motion-capture system."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.config import Config, load_config
from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.suite_drive import parameters_of
from l2m_gtsam.mapping.suite_likelihood import undistorted
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.recording.sync import synchronise
from l2m_gtsam.records.calibration import SensorCalibration, SensorStatus
from l2m_gtsam.storage.bag import read_recording

RUN0 = {
    "ros1": "optitrack_run0_ros1.bag",
    "sqlite3": "optitrack_run0_ros2_sqlite",
}
RUN1 = {
    "ros1": "optitrack_run1_ros1.bag",
    "mcap": "optitrack_run1_ros2_mcap",
}


@pytest.fixture(scope="module")
def config(repository: Path) -> Config:
    return load_config(repository / "configs" / "optitrack.yaml")


def build(bags: Path, kind: str, config: Config) -> FieldMap:
    return map_recordings([read_recording(bags / RUN0[kind], config.bag)], None, config.mapping)


def solve(recording: Recording, field_map: FieldMap, config: Config) -> SensorCalibration:
    return calibrate(recording, field_map, config.calibration).sensors[0]


@pytest.fixture(scope="module")
def run(shared_data: Path, config: Config) -> Recording:
    """Run 1 from its ROS1 bag."""
    return read_recording(shared_data / "bags" / RUN1["ros1"], config.bag)


@pytest.fixture(scope="module")
def ros1(shared_data: Path, config: Config) -> FieldMap:
    """The map of run 0 from its ROS1 bag."""
    return build(shared_data / "bags", "ros1", config)


@pytest.fixture(scope="module")
def plain(run: Recording, ros1: FieldMap, config: Config) -> SensorCalibration:
    """The sensor of run 1 as it is, on the map of run 0, both from ROS1."""
    found = solve(run, ros1, config)
    assert found.status is SensorStatus.SOLVED
    return found


@pytest.mark.study  # that copies of one drive read alike is tested with the reader of bags
def test_every_container_gives_the_same_calibration(
    shared_data: Path, config: Config, plain: SensorCalibration
) -> None:
    """Map from sqlite3 and calibration from mcap, and both from ROS1: equal to 1e-9 (contract)."""
    bags = shared_data / "bags"
    recording = read_recording(bags / RUN1["mcap"], config.bag)
    other = solve(recording, build(bags, "sqlite3", config), config)
    np.testing.assert_allclose(other.vector(), plain.vector(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(other.covariance, plain.covariance, rtol=1e-9, atol=1e-12)


def test_a_known_shift_and_distortion_come_back(
    run: Recording, config: Config, ros1: FieldMap, plain: SensorCalibration
) -> None:
    """Shift the pose origin and distort the readings of run 1: against the run as it is.

    The lever arm of the recording is unknown, so that the two solutions are compared: the shift
    within 5 mm in x and y, C within 0.01, H within 0.3 uT (contract). In z this flat volume says
    little; 10 mm is what its sigma of 2 mm and a correlated map error allow.
    """
    C = np.array([[1.05, 0.03, -0.02], [-0.04, 0.97, 0.05], [0.01, -0.03, 1.02]])
    H = np.array([12.0, -8.0, 5.0])
    shift = np.array([0.10, -0.07, 0.04])
    series = replace(run.series[0], field=run.series[0].field @ C.T + H)
    moved_poses = replace(run.trajectory, p=run.trajectory.p + run.trajectory.R @ shift)
    altered = replace(run, series=(series,), trajectory=moved_poses)
    moved = solve(altered, ros1, config)
    back = plain.t_lidar_mag - moved.t_lidar_mag
    np.testing.assert_allclose(back[:2], shift[:2], atol=0.005)
    np.testing.assert_allclose(back[2], shift[2], atol=0.010)
    np.testing.assert_allclose(moved.distortion.C, C @ plain.distortion.C, atol=0.01)
    np.testing.assert_allclose(moved.distortion.H, C @ plain.distortion.H + H, atol=0.3)


def test_the_calibrated_run_fits_the_map_better(
    run: Recording, config: Config, ros1: FieldMap, plain: SensorCalibration
) -> None:
    """What the calibration is for: less residual than an ideal sensor at the tracked origin."""
    readings = synchronise(run, config.calibration.sync).readings
    fitted = KnownSensor("imu/mag", plain.t_lidar_mag, plain.distortion)
    ideal = KnownSensor.ideal("imu/mag")
    as_ideal, as_fitted = (undistorted(readings, parameters_of(s)[None]) for s in (ideal, fitted))
    before, after = ros1.query(as_ideal.points), ros1.query(as_fitted.points)
    inside = before.inside & after.inside
    raw = np.linalg.norm(as_ideal.field - before.field, axis=1)[inside]
    calibrated = np.linalg.norm(as_fitted.field - after.field, axis=1)[inside]
    assert inside.sum() > 3000
    assert np.median(calibrated) < 0.9 * np.median(raw)

"""A wheeled robot with three magnetometers under motion capture, pass by pass."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FieldSeries, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.mapping.map_building import MappingOptions, map_recordings
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.mapping.suite_likelihood import SuiteCalibrationOptions
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import silent

ROBOT = "aalto_robot_runs1-4.npz"
SENSORS = ("invensense", "trivisio", "nexus")
TRIVISIO_UT = 46.0  # its readings are in units of about so many microtesla
CLOCK_S = 0.15  # one sensor is late by 0.12 to 0.16 s


def robot_pass(folder: Path, run: int, every: int = 1) -> Recording:
    """Return a pass with its captured poses, each ``every``-th of those at 50 Hz."""
    with np.load(folder / ROBOT, allow_pickle=False) as arrays:
        of = (arrays["run"] == run) & arrays["ok"]
        seconds, p, q = (arrays[name][of] for name in ("t", "position", "quaternion_wxyz"))
        field = arrays["mag_body"][of].astype(np.float64)
    field[:, 1] *= TRIVISIO_UT
    stamps = np.round(1e9 * seconds).astype(np.int64)
    R = Rotation.from_quat(q.astype(np.float64), scalar_first=True).as_matrix()
    poses = Trajectory(stamps, R, p.astype(np.float64), "map", "lidar")
    series = tuple(
        FieldSeries(name, f"/{name}", "lidar", stamps, field[:, i])
        for i, name in enumerate(SENSORS)
    )
    return Recording(poses[np.arange(0, len(poses), every)], series, SourceFile(f"run{run}", ""))


def assumed_sensors(folder: Path) -> dict[str, KnownSensor]:
    """Return the sensors at their measured places, otherwise ideal."""
    with np.load(folder / ROBOT, allow_pickle=False) as arrays:
        places = arrays["sensor_positions_body"]
    ideal = Distortion.from_vector(np.append(np.eye(3).ravel(), np.zeros(3)))
    return {name: KnownSensor(name, at, ideal) for name, at in zip(SENSORS, places, strict=True)}


def map_by(passes: Sequence[Recording]) -> FieldMap:
    """Return the map of passes by their first sensor, which is calibrated from them."""
    alone = [replace(each, series=each.series[:1]) for each in passes]
    assumed = {SENSORS[0]: KnownSensor(SENSORS[0], np.zeros(3), Distortion.identity())}
    sensor = calibrate_suite(alone, assumed, SuiteCalibrationOptions(), silent).sensors[0]
    covariance = np.zeros((16, 16))
    covariance[:15, :15] = sensor.covariance
    offset = sensor.time_offset
    assert offset is not None
    covariance[15, 15] = offset.sigma**2
    covariance[:15, 15] = covariance[15, :15] = offset.cross_covariance
    known = KnownSensor(
        SENSORS[0], sensor.t_lidar_mag, sensor.distortion, offset.seconds, covariance
    )
    return map_recordings(alone, {SENSORS[0]: known}, MappingOptions())

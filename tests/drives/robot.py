"""A wheeled robot with three magnetometers under motion capture, pass by pass."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import Distortion, FieldSeries, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions, SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.odometry import drift_covariance
from l2m_gtsam.slam.options import DriftOptions

ROBOT = "aalto_robot_runs1-4.npz"
SENSORS = ("invensense", "trivisio", "nexus")
TRIVISIO_UT = 46.0  # its readings are in units of about so many microtesla
RUNS = (1, 2, 3, 4)
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


@dataclass(frozen=True)
class OtherPasses:
    """The calibration and the map that the passes but one give."""

    suite: CalibrationResult
    field_map: QueryableMap


def other_passes(folder: Path, held_out: int) -> OtherPasses:
    """Return what the other passes give; 14 to 24 s of one core."""
    others = [robot_pass(folder, run) for run in RUNS if run != held_out]
    options = SuiteCalibrationOptions.model_validate(
        {
            "position_m": 0.005,
            "clock_s": 0.1,
            "matrix": 0.03,
            "offset_ut": 10.0,
            "sync": {"thin_distance_m": 0.05},
            "windows": 2,
            "readings": 1500,
            "modes": 250,
        }
    )
    suite = calibrate_suite(others, assumed_sensors(folder), options, silent)
    known = {
        each.sensor: KnownSensor(
            each.sensor,
            each.t_lidar_mag,
            each.distortion,
            0.0 if each.time_offset is None else each.time_offset.seconds,
        )
        for each in suite.sensors
    }
    return OtherPasses(suite, map_recordings(others, known, MappingOptions()))


def walked(truth: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return wheel odometry that drifts as default options say: x, y and heading, step by step."""
    level = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.0])
    back = truth.R[:-1].transpose(0, 2, 1)
    R, p = back @ truth.R[1:], np.einsum("nij,nj->ni", back, np.diff(truth.p, axis=0))
    # What no step is known better than is not drift: at ten poses a second it would be most of it.
    drift = DriftOptions(least_m=1e-6, least_deg=1e-5)
    root = np.linalg.cholesky(drift_covariance(R, p, drift))
    off = level * np.einsum("nij,nj->ni", root, rng.normal(size=(len(p), 6)))
    turns = R @ Rotation.from_rotvec(off[:, :3]).as_matrix()
    steps = p + np.einsum("nij,nj->ni", R, off[:, 3:])
    own, at = [truth.R[0]], [truth.p[0]]
    for turn, step in zip(turns, steps, strict=True):
        at.append(at[-1] + own[-1] @ step)
        own.append(own[-1] @ turn)
    return replace(truth, R=np.stack(own), p=np.stack(at))

"""Surveys of suites that nobody calibrated, in one small hall."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Recording, Trajectory
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.records.calibration import CalibrationResult
from tests.drives.slam import SlamDrive, slam_drive
from tests.worlds.exact import DipoleWorld
from tests.worlds.surveyed import wandering

CLOCK = 0.02  # seconds by which readings are late
QUICK = SuiteCalibrationOptions.model_validate(
    {
        "sync": {"thin_distance_m": 0.05, "thin_angle_deg": 5.0},
        "windows": 1,
        "readings": 600,
        "modes": 150,
    }
)


def suite(seed: int, count: int) -> tuple[KnownSensor, ...]:
    """Return sensors as a mapping suite has them: nearly aligned, not where they were meant."""
    rng, sensors = np.random.default_rng(seed), []
    for index in range(count):
        R = Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()
        C = (np.eye(3) + rng.normal(0, 0.02, (3, 3))) @ R
        t = rng.normal(0, 0.15, 3)
        sensors.append(KnownSensor(f"mag_{index:02d}", t, Distortion(C, rng.normal(0, 5, 3))))
    return tuple(sensors)


def tilted(drive: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return a drive by hand: with all headings and tilts of 0.15 rad, heaving by 0.2 m."""
    at = 1e-9 * (drive.stamp_ns - drive.stamp_ns[0])
    tilts = 0.15 * np.sin(np.outer(at, [0.9, 1.1]) + rng.uniform(0, 6, 2))
    R = drive.R @ Rotation.from_euler("yx", tilts).as_matrix()
    p = drive.p + 0.2 * np.outer(np.sin(0.7 * at), [0, 0, 1])
    return replace(drive, R=R, p=p)


def surveyed(seed: int, sensors: tuple[KnownSensor, ...], world: DipoleWorld) -> Recording:
    """Return a survey with poses that are true and clocks that are late."""
    rng = np.random.default_rng(seed)
    truth = tilted(wandering(rng, 50.0, within=1.5), rng)
    drive: SlamDrive = slam_drive(world, sensors, truth, rng, noise=0.1)
    late = [replace(s, stamp_ns=s.stamp_ns + round(1e9 * CLOCK)) for s in drive.recording.series]
    return replace(drive.recording, trajectory=truth, series=tuple(late))


def errors(found: CalibrationResult, truth: tuple[KnownSensor, ...]) -> FloatArray:
    """Return what 15 parameters of each sensor are off by, but for the scale that all share."""
    scale = np.mean([np.trace(each.distortion.C) / 3 for each in truth])
    off = []
    for each in truth:
        own = found[each.sensor]
        C = own.distortion.C - each.distortion.C / scale
        H = own.distortion.H - each.distortion.H
        off.append(np.concatenate([own.t_lidar_mag - each.t_lidar_mag, C.ravel(), H]))
    return np.stack(off)

"""Drives whose odometry drifts, through fields that are known."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from l2m_gtsam.data import (
    Distortion,
    FieldSeries,
    FloatArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.slam.options import KeyPoseOptions
from l2m_gtsam.studies.slam_array.odometry import slipping
from tests.drives.calibrations import calibration, sensor
from tests.worlds.exact import Field, dipole_world, exact_reading, random_sensors

RATE_HZ = 20
SPEED = 0.6  # m/s
WIDE = np.concatenate([np.full(3, 0.05), np.full(9, 0.05), np.full(3, 10.0)])
COARSE = KeyPoseOptions(readings=3)  # enough, and quick


@dataclass(frozen=True)
class SlamDrive:
    """What was recorded, with odometry that drifts, and where the lidar truly was."""

    recording: Recording
    truth: Trajectory

    @property
    def way(self) -> float:
        return float(np.linalg.norm(np.diff(self.truth.p, axis=0), axis=1).sum())


def ahead(at: FloatArray, p: FloatArray) -> Trajectory:
    """Return a drive along a path, headed where it goes, with a little roll and pitch."""
    v = np.asarray(np.gradient(p, at, axis=0))
    turns = [np.arctan2(v[:, 1], v[:, 0]), 0.02 * np.sin(0.9 * at), 0.02 * np.cos(1.1 * at)]
    R = Rotation.from_euler("ZYX", np.column_stack(turns)).as_matrix()
    stamps = (1e9 * at).astype(np.int64) + 1_700_000_000_000_000_000
    return Trajectory(stamps, R, p, "map", "lidar")


def rounds(seconds: float, radius: float = 2.5) -> Trajectory:
    """Return laps of a rosette about the hall's middle, with a little roll, pitch and heave."""
    at = np.arange(0, seconds, 1 / RATE_HZ)
    angle = SPEED / radius * at
    r = radius * (1 + 0.25 * np.cos(2.3 * angle))
    p = np.column_stack([r * np.cos(angle), r * np.sin(angle), 0.5 + 0.03 * np.sin(1.3 * at)])
    return ahead(at, p)


def laps(seconds: float, radii: tuple[float, float] = (4.0, 2.5)) -> Trajectory:
    """Return laps of an ellipse, never quite the same, with a little roll, pitch and heave."""
    at = np.arange(0, seconds, 1 / RATE_HZ)
    angle = SPEED * at / np.sqrt(np.mean(np.square(radii)))
    wide = radii[0] + 0.15 * np.sin(1.37 * angle + 0.3)
    deep = radii[1] + 0.15 * np.sin(1.71 * angle + 1.0)
    height = 0.5 + 0.03 * np.sin(1.3 * at)
    p = np.column_stack([wide * np.cos(angle), deep * np.sin(angle), height])
    return ahead(at, p)


def slam_drive(
    world: Field,
    sensors: tuple[KnownSensor, ...],
    truth: Trajectory,
    rng: np.random.Generator,
    noise: float = 0.2,
) -> SlamDrive:
    """Return what sensors record along a drive, between its poses in time."""
    stamps = truth.stamp_ns[:-1] + 20_000_000
    slerp = Slerp(1e-9 * (truth.stamp_ns - truth.stamp_ns[0]), Rotation.from_matrix(truth.R))
    at = 1e-9 * (stamps - truth.stamp_ns[0])
    R = slerp(at).as_matrix()
    seconds = 1e-9 * (truth.stamp_ns - truth.stamp_ns[0])
    p = np.column_stack([np.interp(at, seconds, axis) for axis in truth.p.T])
    series = []
    for each in sensors:
        read = exact_reading(world, each, R, p)
        read = read + noise * rng.normal(size=read.shape)
        series.append(FieldSeries(each.sensor, f"/{each.sensor}", each.sensor, stamps, read))
    source = SourceFile("simulated", "00")
    return SlamDrive(Recording(slipping(truth, rng), tuple(series), source), truth)


def calibrated(
    sensors: tuple[KnownSensor, ...],
    noise: float = 0.2,
    sigma: FloatArray | None = None,
    rng: np.random.Generator | None = None,
) -> CalibrationResult:
    """Return a calibration: the truth, or off by normal errors of these sigmas, shape (15,)."""
    entries = []
    sigma = np.full(15, 1e-6) if sigma is None else sigma
    for each in sensors:
        error = np.zeros(15) if rng is None else sigma * rng.normal(size=15)
        vector = each.vector() + error
        entries.append(
            sensor(
                each.sensor,
                t_lidar_mag=vector[:3],
                distortion=Distortion.from_vector(vector[3:]),
                covariance=np.diag(sigma**2),
                noise=noise,
                time_offset=None,
            )
        )
    return calibration(*entries)


def small_hall(seed: int, seconds: float) -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    known, rng = random_sensors(seed, 2), np.random.default_rng(seed)
    return known, slam_drive(dipole_world(1), known, rounds(seconds), rng)

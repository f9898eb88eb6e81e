"""Drives through a place on which one thing, or everything, is not as assumed."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import (
    BoolArray,
    FloatArray,
    KnownSensor,
    Readings,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.simulate.hall_drives import CalibrationDrive
from l2m_gtsam.studies.honesty.drives import drive_seed, driven, misplaced
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions
from l2m_gtsam.studies.troubles.surveys import Place, TroubledPlace

STRONG_UT = 50.0  # field of the Earth, at which a scale that is not linear is stated


def troubled_drive(
    options: TroublesOptions, place: TroubledPlace, trouble: Trouble, number: int
) -> tuple[Recording, tuple[KnownSensor, ...]]:
    """Return a drive by its number as it was recorded, and the truth about its sensors.

    All conditions have the same path, sensors and white noise.
    """
    seed = drive_seed(place.truth.seed, number)
    drive = driven(place.truth.drive(options, seed))
    if trouble.has(Trouble.SMOOTHED):
        drive = smoothed(drive, place.truth, options.smoothed_s)
    rng, readings = np.random.default_rng([seed, 12]), drive.readings
    change, truth = np.zeros_like(readings.field), list(drive.sensors)
    for index in range(len(drive.sensors)):
        rows = readings.rows_of(index)
        seconds = 1e-9 * (readings.stamp_ns[rows] - readings.stamp_ns[rows.start])
        walked = walk(options, trouble, seconds, rng)
        change[rows] = walked + noise_that_lasts(options, trouble, len(seconds), rng)
        if trouble.has(Trouble.STEERING):
            change[rows] += steered(options, readings[np.arange(rows.start, rows.stop)], rng)
        if trouble.has(Trouble.NONLINEAR):
            bent_scale = not_linear(options, readings.field[rows], rng)
            change[rows] += bent_scale
            truth[index] = linear_over(truth[index], readings.field[rows], bent_scale)
        if trouble.has(Trouble.JUMP):
            jump, before = jumped(options, seed, index, drive)
            change[rows] += np.where(before[:, None], 0.0, jump)
            truth[index] = with_offset(truth[index], jump)
        moment = np.random.default_rng([seed, 13, index]).integers(len(walked))
        truth[index] = with_offset(truth[index], walked[moment])
    trajectory = drive.trajectory
    if trouble.has(Trouble.WARP):
        trajectory = bent(trajectory, options, rng)
    if trouble.has(Trouble.POSES) or trouble is Trouble.POSES_STATED:
        trajectory = misplaced(trajectory, options.pose_noise, rng)
    readings = replace(readings, field=readings.field + change)
    recorded = replace(drive, readings=readings, trajectory=trajectory)
    source = SourceFile(f"place-{place.truth.seed}-drive-{number}", "")
    return recorded.recording(source), tuple(truth)


def smoothed(drive: CalibrationDrive, place: Place, constant_s: float) -> CalibrationDrive:
    """Return a drive whose sensors have low-pass filters of first order, with a time constant."""
    sensors, readings = drive.sensors, drive.readings
    # Gauss-Laguerre: the integral over the past of exp(-s / constant), exact for cubes of s.
    past, weight = np.polynomial.laguerre.laggauss(2)
    change = np.zeros_like(readings.field)
    for ago, share in ((0.0, -1.0), *zip(constant_s * past, weight, strict=True)):
        then = with_offsets(readings, drive.trajectory, np.full(len(sensors), -ago))
        for index, sensor in enumerate(sensors):
            rows = readings.rows_of(index)
            R, p = then.R_map_lidar[rows], then.p_map_lidar[rows]
            b_lidar = np.einsum("nji,nj->ni", R, place.built.field(p + R @ sensor.t_lidar_mag))
            change[rows] += share * b_lidar @ sensor.distortion.C.T
    return replace(drive, readings=replace(readings, field=readings.field + change))


def walk(
    options: TroublesOptions, trouble: Trouble, seconds: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return by how much H of a sensor has wandered at each reading, uT, shape (N, 3)."""
    if not trouble.has(Trouble.DRIFT):
        return np.zeros((len(seconds), 3))
    step = np.sqrt(np.diff(seconds, prepend=0.0) / seconds[-1])[:, None]
    steps = step * rng.standard_normal((len(seconds), 3))
    return np.asarray(options.drift_ut * np.cumsum(steps, axis=0))


def noise_that_lasts(
    options: TroublesOptions, trouble: Trouble, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return what is added to a sensor's readings beside white noise, uT, shape (N, 3)."""
    if not trouble.has(Trouble.PINK):
        return np.zeros((count, 3))
    return options.pink_ut * pink(count, rng)


def steered(options: TroublesOptions, readings: Readings, rng: np.random.Generator) -> FloatArray:
    """Return the field of iron that moves with the steering at a sensor's readings, uT, (N, 3)."""
    if readings.motion is None:
        raise ValueError("readings without motion: nothing steers")
    upright = readings.R_map_lidar[:, 2]
    turning = np.einsum("ni,ni->n", upright, readings.motion.twist_lidar[:, :3])
    angle = np.clip(turning / options.steering_rad_s, -1.0, 1.0)
    field = options.steering_ut / np.sqrt(3) * rng.standard_normal(3)
    return np.asarray(angle[:, None] * field)


def jumped(
    options: TroublesOptions, seed: int, index: int, drive: CalibrationDrive
) -> tuple[FloatArray, BoolArray]:
    """Return by how much H of a sensor jumps, uT, shape (3,), and which readings are before."""
    first, last = drive.trajectory.stamp_ns[[0, -1]]
    at = np.random.default_rng([seed, 14]).uniform(*options.jump_at)
    direction = np.random.default_rng([seed, 15, index]).standard_normal(3)
    jump = options.jump_ut * direction / np.linalg.norm(direction)
    # A share of the drive, not of the readings: sensors do not read where structures are near.
    stamps = drive.readings.stamp_ns[drive.readings.rows_of(index)]
    return jump, stamps < first + at * (last - first)


def with_offset(sensor: KnownSensor, change: FloatArray) -> KnownSensor:
    """Return the sensor at one moment of a drive on which H wanders, as sigmas of H mean it.

    At its beginning and end a walk is twice as far from its mean as on average, in squares.
    """
    distortion = replace(sensor.distortion, H=sensor.distortion.H + change)
    return replace(sensor, distortion=distortion)


def not_linear(options: TroublesOptions, field: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return by how much readings are off by a scale that is not linear, uT, shape (N, 3)."""
    sign = rng.choice([-1.0, 1.0], 3)
    return np.asarray(sign * options.nonlinear * field * np.abs(field) / STRONG_UT)


def linear_over(sensor: KnownSensor, field: FloatArray, change: FloatArray) -> KnownSensor:
    """Return the sensor whose C and H come nearest to its readings over a drive's fields.

    A scale that is not linear has no C but that of the fields it is used in.
    """
    known = np.column_stack([field, np.ones(len(field))])
    slope, offset = np.split(np.linalg.lstsq(known, change, rcond=None)[0].T, [3], axis=1)
    grown, old = np.eye(3) + slope, sensor.distortion
    distortion = replace(old, C=grown @ old.C, H=grown @ old.H + offset[:, 0])
    return replace(sensor, distortion=distortion)


def pink(count: int, rng: np.random.Generator) -> FloatArray:
    """Return noise of a power that falls with frequency, of unit variance, shape (N, 3)."""
    spectrum = np.fft.rfft(rng.standard_normal((count, 3)), axis=0)
    frequency = np.fft.rfftfreq(count)
    spectrum[1:] /= np.sqrt(frequency[1:, None])
    spectrum[0] = 0.0
    noise = np.fft.irfft(spectrum, count, axis=0)
    return np.asarray(noise / noise.std(axis=0))


def bent(true: Trajectory, options: TroublesOptions, rng: np.random.Generator) -> Trajectory:
    """Return poses in a frame that is bent: slow waves along x and y, and headings with them."""
    wave = 2 * np.pi / options.warp_length_m
    phase = rng.uniform(-np.pi, np.pi, (2, 2))
    at = wave * true.p[:, None, :2] + phase  # of the shift along each axis, along each axis
    shift = np.column_stack([options.warp_m * np.sin(at).mean(axis=2), np.zeros(len(at))])
    slope = 0.5 * options.warp_m * wave * np.cos(at)
    turn = np.zeros_like(shift)
    turn[:, 2] = 0.5 * (slope[:, 1, 0] - slope[:, 0, 1])  # half the curl
    R = Rotation.from_rotvec(turn).as_matrix() @ true.R
    return replace(true, R=R, p=true.p + shift)

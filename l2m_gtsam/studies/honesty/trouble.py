"""Drives on which clock, poses and readings are wrong together."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions, pose_roots
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.simulate.hall_drives import STEP_NS, CalibrationDrive

SHARE = 0.1  # of the readings
LATE_S = 0.04  # clocks are off by up to this
FASTEST_M_S, FASTEST_RAD_S = 1.0, 1.0
POSE_NOISE = PoseNoiseOptions(position_m=0.005, rotation_deg=0.1, correlation_s=1.0)


@dataclass(frozen=True)
class Disturbed:
    """A drive with something wrong, and by how much each reading is off in uT, shape (N,)."""

    drive: CalibrationDrive
    change: FloatArray


def disturbed(drive: CalibrationDrive, change: FloatArray) -> Disturbed:
    """Return the drive with changes in uT, shape (N, 3), added to its readings."""
    readings = replace(drive.readings, field=drive.readings.field + change)
    return Disturbed(replace(drive, readings=readings), np.linalg.norm(change, axis=1))


def spikes(drive: CalibrationDrive, seed: int) -> Disturbed:
    """Return a drive of which a tenth of the readings is off by tens of microtesla."""
    rng = np.random.default_rng([seed, 1])
    wrong = rng.random(len(drive.readings)) < SHARE
    return disturbed(drive, wrong[:, None] * 50 * rng.standard_normal((len(wrong), 3)))


def troubled(drive: CalibrationDrive, seed: int) -> Disturbed:
    """Return a drive with clocks, poses and a tenth of its readings wrong."""
    spiked = spikes(driven(drive), seed)
    return replace(spiked, drive=misplaced(mistimed(spiked.drive, seed), seed))


def driven(drive: CalibrationDrive) -> CalibrationDrive:
    """Return a drive at the speeds of a vehicle: the paths of halls jump round what is in the way.

    The vehicle goes on in a straight line and turns at a constant rate from pose to pose.
    """
    path = drive.trajectory
    way = np.linalg.norm(np.diff(path.p, axis=0), axis=1) / FASTEST_M_S
    between = path.R[:-1].transpose(0, 2, 1) @ path.R[1:]
    turn = Rotation.from_matrix(between).magnitude() / FASTEST_RAD_S
    step = np.maximum(np.maximum(way, turn), 1e-9 * STEP_NS)
    stamps = np.round(1e9 * np.concatenate([[0.0], np.cumsum(step)])).astype(np.int64)
    readings = replace(drive.readings, stamp_ns=stamps[drive.readings.stamp_ns // STEP_NS])
    return placed(replace(drive, readings=readings, trajectory=replace(path, stamp_ns=stamps)))


def mistimed(drive: CalibrationDrive, seed: int) -> CalibrationDrive:
    """Return a drive whose sensors' clocks are off: the true pose is that at stamp + offset."""
    rng = np.random.default_rng([seed, 7])
    offset = rng.uniform(-LATE_S, LATE_S, len(drive.sensors))
    late = np.round(1e9 * offset).astype(np.int64)[drive.readings.sensor]
    readings = replace(drive.readings, stamp_ns=drive.readings.stamp_ns - late)
    return placed(replace(drive, readings=readings, offset=offset))


def misplaced(drive: CalibrationDrive, seed: int) -> CalibrationDrive:
    """Return a drive whose poses are wrong by errors that last, as ``POSE_NOISE`` says."""
    true, rng = drive.trajectory, np.random.default_rng([seed, 8])
    seconds: FloatArray = 1e-9 * true.stamp_ns.astype(np.float64)
    u = lasting(seconds, POSE_NOISE.correlation_s, rng)
    sigmas = np.repeat([np.deg2rad(POSE_NOISE.rotation_deg or 0), POSE_NOISE.position_m or 0], 3)
    # true = measured Exp(error)
    turn, shift = np.split(u * sigmas, 2, axis=1)
    R = true.R @ Rotation.from_rotvec(-turn).as_matrix()
    p = true.p - np.einsum("nij,nj->ni", R, shift)
    measured = Trajectory(true.stamp_ns, R, p, true.frame, true.child_frame)
    return placed(replace(drive, trajectory=measured))


def placed(drive: CalibrationDrive) -> CalibrationDrive:
    """Return a drive with poses as its trajectory has them at the readings' stamps."""
    nothing = np.zeros(len(drive.sensors))
    readings: Readings = with_offsets(drive.readings, drive.trajectory, nothing)
    roots = pose_roots(drive.trajectory, readings.stamp_ns, POSE_NOISE)
    return replace(drive, readings=replace(readings, pose_root=roots))


def lasting(seconds: FloatArray, lasts_s: float, rng: np.random.Generator) -> FloatArray:
    """Return six Ornstein-Uhlenbeck processes of unit variance at times, shape (N, 6)."""
    u = rng.standard_normal((len(seconds), 6))
    like = np.exp(-np.diff(seconds) / lasts_s)
    for n, rho in enumerate(like, start=1):
        u[n] = rho * u[n - 1] + np.sqrt(1 - rho**2) * u[n]
    return u

"""Drives whose errors are drawn as the graph states them: start, odometry, calibration, noise."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import KeyPoseReadings
from l2m_gtsam.data import FloatArray, KnownSensor, RigidTransform, Trajectory
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose, as_poses
from l2m_gtsam.slam.odometry import odometry_steps
from l2m_gtsam.slam.options import DriftOptions
from tests.worlds.exact import Field

START = np.repeat([np.deg2rad(2.0), 0.1], 3)  # sigmas of the first pose, rad and m
DRIFT = DriftOptions(steady=0.0)  # none is drawn
PIECE = 5_000  # places that a world is asked at once


@dataclass(frozen=True)
class DrawnDrive:
    """A drive, and what it was drawn from.

    ``R``, ``p`` are the true key poses, shapes (K, 3, 3) and (K, 3); ``calibration`` is the truth
    of (t, C row by row, H) of the sensors, shape (S, 15).
    """

    drive: Drive
    R: FloatArray
    p: FloatArray
    calibration: FloatArray

    @property
    def poses(self) -> list[gtsam.Pose3]:
        """The true key poses."""
        return as_poses(self.R, self.p)

    def reckoned_off(self, drive: Drive) -> float:
        """Return by how much odometry of a drive ends off the true path, metres."""
        return float(np.linalg.norm(drive.dead_reckoning()[-1].translation() - self.p[-1]))


def drawn_drive(
    world: Field,
    sensors: tuple[KnownSensor, ...],
    truth: Trajectory,
    rng: np.random.Generator,
    sigma: FloatArray,
    noise: float = 0.2,
    every: int = 1,
    drift: DriftOptions = DRIFT,
) -> DrawnDrive:
    """Return a drive along true poses, every so manieth of which is a key pose.

    All poses have a reading of each sensor, and odometry errs from each to the next; ``sigma``,
    shape (15,), is that of what is known of each sensor.
    """
    rows = np.arange(0, len(truth), every)
    truth = truth[np.arange(rows[-1] + 1)]
    Q = odometry_steps(truth, rows, drift).covariance
    odometry = drawn_odometry(truth, np.repeat(Q / every, every, axis=0), rng)
    steps = replace(odometry_steps(odometry, rows, drift), covariance=Q)
    begin = perturbations(np.diag(START**2)[None], rng)
    R0, p0 = truth.R[0], truth.p[0]
    start = StartPose(RigidTransform(R0 @ begin.R[0], p0 + R0 @ begin.p[0]), np.diag(START**2))
    ideal = np.stack([each.vector() for each in sensors])
    given = ideal + sigma * rng.normal(size=ideal.shape)
    known = KnownSensors(
        names=tuple(each.sensor for each in sensors),
        t=given[:, :3],
        distortion=given[:, 3:],
        offset=np.zeros(len(sensors)),
        noise=np.full(len(sensors), noise),
        covariance=np.tile(np.diag(sigma**2), (len(sensors), 1, 1)),
    )
    readings = drawn_readings(world, ideal, truth, odometry, every, rng, noise)
    times = np.repeat(truth.stamp_ns, len(sensors))
    drive = Drive(truth.stamp_ns[rows], steps, readings, start, known, times)
    return DrawnDrive(drive, truth.R[rows], truth.p[rows], ideal)


def drawn_odometry(truth: Trajectory, Q: FloatArray, rng: np.random.Generator) -> Trajectory:
    """Return a drive by odometry whose steps err by these covariances, (N - 1, 6, 6)."""
    true = odometry_steps(truth, np.arange(len(truth)), DriftOptions())
    off = perturbations(Q, rng)
    R, p = [truth.R[0]], [truth.p[0]]
    for turn, way in zip(true.R @ off.R, true.p + moved(true.R, off.p), strict=True):
        p.append(p[-1] + R[-1] @ way)
        R.append(R[-1] @ turn)
    return replace(truth, R=np.stack(R), p=np.stack(p))


@dataclass(frozen=True)
class Perturbations:
    """Small motions, shapes (N, 3, 3) and (N, 3)."""

    R: FloatArray
    p: FloatArray


def perturbations(covariance: FloatArray, rng: np.random.Generator) -> Perturbations:
    """Draw motions whose logarithms have these covariances, rotation first, shape (N, 6, 6)."""
    drawn = np.linalg.cholesky(covariance) @ rng.normal(size=(len(covariance), 6, 1))
    w, v = drawn[:, :3, 0], drawn[:, 3:, 0]
    # The logarithm of a motion turns its way by half the turn, to first order.
    return Perturbations(Rotation.from_rotvec(w).as_matrix(), v + 0.5 * np.cross(w, v))


def moved(R: FloatArray, p: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nij,nj->ni", R, p))


def drawn_readings(
    world: Field,
    calibration: FloatArray,
    truth: Trajectory,
    odometry: Trajectory,
    every: int,
    rng: np.random.Generator,
    noise: float,
) -> KeyPoseReadings:
    """Return a reading of each sensor at each pose, in order of poses.

    At a key pose it is the last one of the step that ends there.
    """
    count = len(calibration)
    pose, sensor = np.divmod(np.arange(len(truth) * count), count)
    key = np.maximum(pose - 1, 0) // every * every
    R, p = truth.R[pose], truth.p[pose]
    x = moved(R, calibration[sensor, :3]) + p
    pieces = np.array_split(x, len(x) // PIECE + 1)
    B = np.concatenate([world.field_and_gradient(piece)[0] for piece in pieces])
    C = calibration[sensor, 3:12].reshape(-1, 3, 3)
    field = moved(C @ R.transpose(0, 2, 1), B) + calibration[sensor, 12:]
    R_back = odometry.R[key].transpose(0, 2, 1)
    return KeyPoseReadings(
        key_pose=key // every,
        sensor=sensor,
        R_key_lidar=R_back @ odometry.R[pose],
        p_key_lidar=moved(R_back, odometry.p[pose] - odometry.p[key]),
        fraction=(pose - key) / every,
        field=field + noise * rng.normal(size=field.shape),
    )

"""SLAM without a map, method by method: what each makes of one drive with one sensor."""

from dataclasses import dataclass
from time import process_time

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, IntArray, SyncCounts, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.slam.exploration import NOTHING_GAINED, explore
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.peers.reduced_rank_ekf import ReducedRankEkfOptions, reduced_rank_ekf
from l2m_gtsam.studies.slam.recipes import DriftRecipe, Form
from l2m_gtsam.studies.slam.recordings import TrueDrive
from l2m_gtsam.studies.statistics import nees

EXACT = 1e-10  # variance of a calibration that is taken as given
OVER_M = 10.0  # over which the drift is stated
PARAMETERS = 15


@dataclass(frozen=True)
class MethodRow:
    """One method on one drive with one odometry.

    Attributes
    ----------
    rms_m
        Error of the positions of the key poses.
    nees
        Mean normalised squared error of their poses, 6 where sigmas are right; None where the
        method states none.
    ms_per_pose
        Processor milliseconds per key pose.
    unchanged
        Whether the method returned odometry, as nothing was gained.
    """

    rms_m: float
    nees: float | None
    ms_per_pose: float
    unchanged: bool = False


def odometry_row(drive: TrueDrive, odometry: Trajectory, rows: IntArray) -> MethodRow:
    """Return the errors of odometry alone at rows of a drive."""
    return MethodRow(rms(odometry.p[rows], drive.truth.p[rows]), None, 0.0)


def filter_row(
    drive: TrueDrive, odometry: Trajectory, rows: IntArray, options: ReducedRankEkfOptions
) -> MethodRow:
    """Return those of the reduced-rank Kalman filter, whose box is about the true path."""
    box = np.stack([drive.truth.p.min(axis=0), drive.truth.p.max(axis=0)])
    begun = process_time()
    found = reduced_rank_ekf(odometry, drive.field, box, options)
    taken = process_time() - begun
    estimate = Trajectory(
        odometry.stamp_ns, found.R, found.p, "map", "lidar", covariance=found.covariance
    )
    return MethodRow(
        rms(found.p[rows], drive.truth.p[rows]),
        mean_nees(estimate[rows], drive.truth[rows]),
        1e3 * taken / len(rows),
    )


def our_row(
    drive: TrueDrive, odometry: Trajectory, options: SlamOptions, noise_ut: float
) -> tuple[MethodRow, IntArray]:
    """Return those of ``l2m slam`` without a map, and the rows of its key poses."""
    begun = process_time()
    result = explore(drive.recording(odometry), as_recorded(noise_ut), options, silent).result
    taken, found = process_time() - begun, result.trajectory
    rows = np.searchsorted(drive.truth.stamp_ns, found.stamp_ns)
    truth = drive.truth[rows]
    return (
        MethodRow(
            rms(found.p, truth.p),
            mean_nees(found, truth),
            1e3 * taken / len(rows),
            NOTHING_GAINED in result.notes,
        ),
        rows,
    )


def stated_drift(truth: Trajectory, recipe: DriftRecipe, form: Form) -> SlamOptions:
    """Return options that state how far errors come in 10 m, and nothing else."""
    length = np.linalg.norm(np.diff(truth.p, axis=0), axis=1).mean()
    steps = OVER_M / length
    drift = {
        "position_share": np.hypot(steps * recipe.drift_m, np.sqrt(steps) * recipe.level_m)
        / OVER_M,
        "rotation_deg_per_m": np.rad2deg(np.sqrt(steps) * recipe.turn_rad) / OVER_M,
        "axes": "fixed" if form is Form.WORLD else "vehicle",
        "over_m": OVER_M,
    }
    return SlamOptions.model_validate({"drift": drift})


def as_recorded(noise_ut: float) -> CalibrationResult:
    """Return a calibration that undoes nothing, for recordings that come without one."""
    sensor = SensorCalibration(
        sensor="mag",
        status=SensorStatus.SOLVED,
        message="as recorded",
        t_lidar_mag=np.zeros(3),
        distortion=Distortion.identity(),
        R_lidar_mag=np.eye(3),
        covariance=EXACT * np.eye(PARAMETERS),
        rotation_covariance=EXACT * np.eye(3),
        noise=noise_ut,
        residuals=None,
        undetermined=(),
        sync=SyncCounts(0, 0, 0, 0, 0, 0, 0),
        outside_map=0,
        time_offset=None,
    )
    return CalibrationResult((sensor,), 0, Uncertainty.FULL, (), (), None, None, {}, {})


def rms(p: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square distance of positions, shapes (N, 3)."""
    return float(np.sqrt(np.mean(np.sum((p - truth) ** 2, axis=1))))


def mean_nees(estimate: Trajectory, truth: Trajectory) -> float | None:
    """Return the mean over all poses but the first, which is given; None without covariances."""
    if estimate.covariance is None:
        return None
    turn = Rotation.from_matrix(estimate.R.transpose(0, 2, 1) @ truth.R).as_rotvec()
    shift = np.einsum("nji,nj->ni", estimate.R, truth.p - estimate.p)
    return float(nees(np.hstack([turn, shift])[1:], estimate.covariance[1:]).mean())

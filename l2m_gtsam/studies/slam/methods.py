"""SLAM without a map, method by method: cells of the study, and what each makes of one drive."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import Field
from scipy.stats import chi2

from l2m_gtsam.data import FloatArray, IntArray, KnownSensor, Recording, SyncCounts, Trajectory
from l2m_gtsam.geometry import polar_rotation
from l2m_gtsam.options import Options
from l2m_gtsam.progress import silent
from l2m_gtsam.qa.metrics.trajectory import compared
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.online.replay import give, messages
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.measured import MeasuredWork, measured
from l2m_gtsam.studies.peers.fixed_lag import FixedLagOptions, fixed_lag_slam
from l2m_gtsam.studies.peers.particle_filters import ParticleSlamOptions, particle_slam
from l2m_gtsam.studies.peers.reduced_rank_ekf import (
    POSE,
    ReducedRankEkfOptions,
    reduced_rank_ekf,
)
from l2m_gtsam.studies.slam.recordings import (
    DriftRecipe,
    Form,
    TrueDrive,
    drifted,
)
from l2m_gtsam.studies.statistics import LEVEL, nees

EXACT = 1e-10  # variance of a calibration that is taken as given
OVER_M = 10.0  # over which the drift is stated
PARAMETERS = 15
INSIDE = float(chi2.ppf(LEVEL, POSE))  # squared error in sigmas of the innermost 95 %


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
    inside
        Share of the poses that are within their own 95 %; None where it states none.
    peak_mib
        By how much memory grew at most, MiB; None where the system does not report it.
    """

    rms_m: float
    nees: float | None
    ms_per_pose: float
    unchanged: bool = False
    inside: float | None = None
    peak_mib: float | None = None

    @classmethod
    def of(
        cls, took: MeasuredWork[Trajectory], truth: Trajectory, *, unchanged: bool = False
    ) -> "MethodRow":
        """Return the figures of an estimate and true poses, in whose file its times are."""
        found = took.result
        truth = truth[np.searchsorted(truth.stamp_ns, found.stamp_ns)]
        squared = squared_errors(found, truth)
        return cls(
            rms_m=rms(found.p, truth.p),
            nees=None if squared is None else float(squared.mean()),
            inside=None if squared is None else float(np.mean(squared < INSIDE)),
            ms_per_pose=1e3 * took.seconds / max(len(found), 1),
            peak_mib=took.peak_mib,
            unchanged=unchanged,
        )

    @classmethod
    def of_odometry(cls, odometry: Trajectory, truth: Trajectory) -> "MethodRow":
        """Return the errors of odometry alone, of which nothing is stated; rows are the same."""
        return cls(rms(odometry.p, truth.p), None, 0.0)


def odometry_row(drive: TrueDrive, odometry: Trajectory, rows: IntArray) -> MethodRow:
    """Return the errors of odometry alone at rows of a drive."""
    return MethodRow.of_odometry(odometry[rows], drive.truth[rows])


def peer_row(
    drive: TrueDrive, rows: IntArray, method: Callable[[FloatArray], Trajectory]
) -> MethodRow:
    """Return those of a peer, whose box is about the true path."""
    box = np.stack([drive.truth.p.min(axis=0), drive.truth.p.max(axis=0)])
    took = measured(lambda: method(box))
    return MethodRow.of(took.of(took.result[rows]), drive.truth)


def online_row(
    drive: TrueDrive, odometry: Trajectory, options: SlamOptions, noise_ut: float
) -> MethodRow:
    """Return those of ``l2m slam --online`` without a map: each pose when it is made."""
    recording, sensor = drive.recording(odometry), as_recorded(noise_ut)
    took = measured(lambda: followed(recording, OnlineSlam(sensor, options)))
    return MethodRow.of(took, drive.truth)


def followed(recording: Recording, slam: OnlineSlam) -> Trajectory:
    """Return the key poses of a recording on line, each as it was known when it was made."""
    poses = [pose for each in messages(recording) for pose in give(slam, each)]
    last = slam.finish()
    poses = [*(each for each in poses if each.stamp_ns < last[0].stamp_ns), *last]
    return Trajectory(
        np.array([each.stamp_ns for each in poses]),
        np.stack([each.T_map_lidar.R for each in poses]),
        np.stack([each.T_map_lidar.t for each in poses]),
        "map",
        "lidar",
        covariance=np.stack([each.covariance for each in poses]),
    )


def our_row(
    drive: TrueDrive, odometry: Trajectory, options: SlamOptions, noise_ut: float
) -> tuple[MethodRow, IntArray]:
    """Return those of ``l2m slam`` without a map, and the rows of its key poses."""
    recording, sensor = drive.recording(odometry), as_recorded(noise_ut)
    took = measured(lambda: explore(recording, sensor, options, silent).result)
    row = MethodRow.of(
        took.of(took.result.trajectory),
        drive.truth,
        unchanged=took.result.gain is not None and not took.result.gain.shown,
    )
    return row, np.searchsorted(drive.truth.stamp_ns, took.result.trajectory.stamp_ns)


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
    return given_sensors([KnownSensor.ideal("mag")], noise_ut)


def given_sensors(sensors: Sequence[KnownSensor], noise_ut: float) -> CalibrationResult:
    """Return the calibration of sensors that are known exactly."""
    entries = tuple(
        SensorCalibration(
            sensor=each.sensor,
            status=SensorStatus.SOLVED,
            message="given",
            t_lidar_mag=each.t_lidar_mag,
            distortion=each.distortion,
            R_lidar_mag=polar_rotation(each.distortion.C, EXACT * np.eye(9)).R_mag_lidar.T,
            covariance=EXACT * np.eye(PARAMETERS),
            rotation_covariance=EXACT * np.eye(3),
            noise=noise_ut,
            residuals=None,
            undetermined=(),
            sync=SyncCounts(0, 0, 0, 0, 0, 0, 0),
            outside_map=0,
            time_offset=None,
        )
        for each in sensors
    )
    return CalibrationResult(entries, 0, Uncertainty.FULL, (), (), None, None, {}, {})


def rms(p: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square distance of positions, shapes (N, 3)."""
    return float(np.sqrt(np.mean(np.sum((p - truth) ** 2, axis=1))))


def squared_errors(estimate: Trajectory, truth: Trajectory) -> FloatArray | None:
    """Return the squared errors of all poses but the first, which is given, in their own sigmas.

    None where the estimate has no covariances.
    """
    if estimate.covariance is None:
        return None
    return nees(compared(truth, estimate).right[1:], estimate.covariance[1:])


RECORDINGS = ("ship-1", "ship-2", "hand-0", "hand-1")
WALK_TIMES = 10.0  # the drift of a step as noise of the walk: half a metre in 500 steps


class DriftKind(StrEnum):
    """Which errors odometry has."""

    PUBLISHED = "published"
    WALK = "walk"


class SlamStudyOptions(Options):
    """Of the study of SLAM in an unknown field."""

    data: str = "../shared/data"
    """Folder of the recordings, which are no part of this package."""
    recordings: tuple[str, ...] = RECORDINGS
    """Runs of the ship and of a sensor in the hand, and `robot-1` to `robot-4`: passes whose field
    has so much detail that a drive takes ten minutes and more."""
    seed: int = Field(default=0, ge=0)
    """The first;"""
    seeds: int = Field(default=2, ge=1)
    """and how many, of the drift's noise."""
    noise_ut: float = Field(default=5.0, gt=0)
    """Of a reading per axis, as the publication on the ship has it: a tenth of the field."""
    drift: DriftRecipe = DriftRecipe()
    """Errors of odometry. The random walk has none that all steps share, and ten times as much
    noise more."""
    filter: ReducedRankEkfOptions = ReducedRankEkfOptions()
    """Field, noise and errors of steps that the peers assume."""
    particles: ParticleSlamOptions = ParticleSlamOptions()
    """Parameters of the particle filter,"""
    fixed_lag: FixedLagOptions = FixedLagOptions()
    """and of GTSAM's fixed-lag smoother."""


@dataclass(frozen=True)
class SlamCell:
    """What the methods make of one drive with one odometry.

    Attributes
    ----------
    path_m, key_poses
        Length of the true path, and number of key poses of ``l2m slam``.
    odometry
        Odometry alone.
    ekf, particles, fixed_lag
        The peers.
    online, ours
        ``l2m slam`` on line and off line.
    """

    path_m: float
    key_poses: int
    odometry: MethodRow
    ekf: MethodRow
    particles: MethodRow
    fixed_lag: MethodRow
    online: MethodRow
    ours: MethodRow


def computed(options: SlamStudyOptions, key: str, drive: TrueDrive) -> SlamCell:
    """Return a cell."""
    *_, kind, form, seed = key.split("-")
    recipe = recipe_of(DriftKind(kind), options.drift)
    odometry = drifted(drive.truth, recipe, Form(form), int(seed))
    stated = stated_drift(drive.truth, recipe, Form(form))
    ours, rows = our_row(drive, odometry, stated, options.noise_ut)
    model, field = options.filter, drive.field
    peers: tuple[Callable[[FloatArray], Trajectory], ...] = (
        lambda box: reduced_rank_ekf(odometry, field, box, model),
        lambda box: particle_slam(odometry, field, box, model, options.particles, int(seed)),
        lambda box: fixed_lag_slam(odometry, field, box, model, options.fixed_lag),
    )
    ekf, particles, fixed_lag = (peer_row(drive, rows, method) for method in peers)
    return SlamCell(
        path_m=float(drive.path_m),
        key_poses=len(rows),
        odometry=odometry_row(drive, odometry, rows),
        ekf=ekf,
        particles=particles,
        fixed_lag=fixed_lag,
        online=online_row(drive, odometry, stated, options.noise_ut),
        ours=ours,
    )


def recipe_of(kind: DriftKind, published: DriftRecipe) -> DriftRecipe:
    """Return the errors of a kind of drift."""
    if kind is DriftKind.PUBLISHED:
        return published
    level = published.level_m + WALK_TIMES * published.drift_m
    return published.model_copy(update={"drift_m": 0.0, "level_m": level})

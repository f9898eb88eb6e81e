"""SLAM without a map, method by method: cells of the study, and what each makes of one drive."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from time import process_time

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, IntArray, SyncCounts, Trajectory
from l2m_gtsam.options import Options
from l2m_gtsam.progress import silent
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
from l2m_gtsam.studies.peers.fixed_lag import FixedLagOptions, fixed_lag_slam
from l2m_gtsam.studies.peers.particle_slam import ParticleSlamOptions, particle_slam
from l2m_gtsam.studies.peers.reduced_rank_ekf import (
    FilteredPath,
    ReducedRankEkfOptions,
    reduced_rank_ekf,
)
from l2m_gtsam.studies.slam.recordings import (
    HANDHELD,
    ROBOT,
    SHIP,
    DriftRecipe,
    Form,
    TrueDrive,
    drifted,
    handheld_run,
    robot_run,
    ship_run,
)
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


def peer_row(
    drive: TrueDrive, rows: IntArray, method: Callable[[FloatArray], FilteredPath]
) -> MethodRow:
    """Return those of a peer, whose box is about the true path."""
    box = np.stack([drive.truth.p.min(axis=0), drive.truth.p.max(axis=0)])
    begun = process_time()
    found = method(box)
    taken = process_time() - begun
    estimate = Trajectory(
        drive.truth.stamp_ns, found.R, found.p, "map", "lidar", covariance=found.covariance
    )
    return MethodRow(
        rms(found.p[rows], drive.truth.p[rows]),
        mean_nees(estimate[rows], drive.truth[rows]),
        1e3 * taken / len(rows),
    )


def online_row(
    drive: TrueDrive, odometry: Trajectory, options: SlamOptions, noise_ut: float
) -> MethodRow:
    """Return those of ``l2m slam --online`` without a map: each pose when it is made."""
    begun = process_time()
    slam = OnlineSlam(as_recorded(noise_ut), options)
    poses = [pose for each in messages(drive.recording(odometry)) for pose in give(slam, each)]
    last = slam.finish()
    taken = process_time() - begun
    poses = [*(each for each in poses if each.stamp_ns < last[0].stamp_ns), *last]
    found = Trajectory(
        np.array([each.stamp_ns for each in poses]),
        np.stack([each.T_map_lidar.R for each in poses]),
        np.stack([each.T_map_lidar.t for each in poses]),
        "map",
        "lidar",
        covariance=np.stack([each.covariance for each in poses]),
    )
    truth = drive.truth[np.searchsorted(drive.truth.stamp_ns, found.stamp_ns)]
    return MethodRow(
        rms(found.p, truth.p), mean_nees(found, truth), 1e3 * taken / max(len(poses), 1)
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
            result.gain is not None and not result.gain.shown,
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


def cell_keys(options: SlamStudyOptions) -> tuple[str, ...]:
    """Return all cells."""
    return tuple(
        f"{site}-{kind}-{form}-{options.seed + number}"
        for site in options.recordings
        for kind in DriftKind
        for form in Form
        for number in range(options.seeds)
    )


def site_of(key: str) -> str:
    """Return the recording of a cell."""
    return "-".join(key.split("-")[:2])


READERS = {
    "ship": (ship_run, SHIP),
    "hand": (handheld_run, HANDHELD),
    "robot": (robot_run, ROBOT),
}


def read_drive(options: SlamStudyOptions, site: str) -> TrueDrive:
    """Return a recording with its true poses."""
    carrier, run = site.split("-")
    read, name = READERS[carrier]
    return read(Path(options.data) / name, int(run))


def computed(options: SlamStudyOptions, key: str, drive: TrueDrive) -> SlamCell:
    """Return a cell."""
    *_, kind, form, seed = key.split("-")
    recipe = recipe_of(DriftKind(kind), options.drift)
    odometry = drifted(drive.truth, recipe, Form(form), int(seed))
    stated = stated_drift(drive.truth, recipe, Form(form))
    ours, rows = our_row(drive, odometry, stated, options.noise_ut)
    model, field = options.filter, drive.field
    peers: tuple[Callable[[FloatArray], FilteredPath], ...] = (
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

"""A localised drive as arrays, and its poses against the truth: metres, degrees, covariances."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import BoolArray, FloatArray, Trajectory
from l2m_gtsam.errors import SyncError
from l2m_gtsam.geometry import to_ros
from l2m_gtsam.qa.metrics.plain import row, rows
from l2m_gtsam.recording.sync import has_pose, interpolated
from l2m_gtsam.records.localisation_file import (
    POSE_FREEDOM,
    LocalisationRecord,
    PoseErrors,
    TruthRecord,
)
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.noise import rms

HEADING = 5  # of x, y, z, and rotations about them


@dataclass(frozen=True)
class LocalisedTrajectory:
    """K key poses.

    Attributes
    ----------
    seconds, distance
        Since the first, in s and in m along the localised path, shape (K,).
    p, odometry
        DriveSolution places, and those of odometry alone, in the map in metres, shape (K, 3).
    apart, turned
        Distance of both in m and angle of both in degrees, shape (K,).
    covariance
        Of the places in m^2 along the axes of the map, shape (K, 3, 3); NaN where unknown.
    sigma, odometry_sigma
        Of localised poses and of odometry alone: along x, y, z of the map in m, and about them in
        degrees, shape (K, 6).
    """

    seconds: FloatArray
    distance: FloatArray
    p: FloatArray
    odometry: FloatArray
    apart: FloatArray
    turned: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    odometry_sigma: FloatArray

    @property
    def heading_sigma(self) -> FloatArray:
        """Of localised poses in degrees, shape (K,)."""
        return self.sigma[:, HEADING]

    @property
    def position_sigma(self) -> FloatArray:
        """The largest along an axis of the map in metres, shape (K,)."""
        return np.asarray(self.sigma[:, :3].max(axis=1))

    def place_at(self, second: float) -> tuple[float, float]:
        """Return where the lidar was then, x and y in the map in metres."""
        x, y = (float(np.interp(second, self.seconds, axis)) for axis in self.p[:, :2].T)
        return x, y


def localised_trajectory(record: LocalisationRecord) -> LocalisedTrajectory:
    """Return the key poses of a drive."""
    stamps = np.array([each.stamp_ns for each in record.poses])
    p, odometry = (np.array([each.p for each in part]) for part in (record.poses, record.odometry))
    R, alone = (
        Rotation.from_quat([each.quaternion_xyzw for each in part])
        for part in (record.poses, record.odometry)
    )
    covariance = to_ros(_covariances(record), R.as_matrix())
    degrees = np.repeat([1.0, np.rad2deg(1.0)], 3)
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    return LocalisedTrajectory(
        seconds=1e-9 * (stamps - stamps[0]),
        distance=np.append(0.0, np.cumsum(steps)),
        p=p,
        odometry=odometry,
        apart=np.linalg.norm(odometry - p, axis=1),
        turned=np.rad2deg((R.inv() * alone).magnitude()),
        covariance=covariance[:, :3, :3],
        sigma=np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * degrees,
        odometry_sigma=np.array([each.sigma for each in record.odometry]),
    )


def _covariances(record: LocalisationRecord) -> FloatArray:
    """Return the covariances of right perturbations, shape (K, 6, 6)."""
    unknown = np.full((6, 6), np.nan)
    return np.stack(
        [unknown if each.covariance is None else np.array(each.covariance) for each in record.poses]
    )


@dataclass(frozen=True)
class Compared:
    """N poses less the truth at the same times, nothing aligned.

    Attributes
    ----------
    right
        Right perturbations, ``T_true = T Exp(error)``, to first order in the translation: rotation
        (rad), then translation (m), along the axes of the body, shape (N, 6).
    """

    right: FloatArray

    @property
    def distance(self) -> FloatArray:
        """Between the positions in metres, shape (N,)."""
        return np.asarray(np.linalg.norm(self.right[:, 3:], axis=1))

    @property
    def angle(self) -> FloatArray:
        """Between the rotations in degrees, shape (N,)."""
        return np.asarray(np.rad2deg(np.linalg.norm(self.right[:, :3], axis=1)))

    def squared(self, covariance: FloatArray) -> FloatArray:
        """Return squared errors in units of covariances, shape (N, 6, 6), as (N,): NEES."""
        # e^T P^-1 e, six in the mean if P is true (Bar-Shalom et al. 2001, sec. 5.4).
        e = self.right[:, :, None]
        return np.asarray((e * np.linalg.solve(covariance, e)).sum(axis=(1, 2)))

    def figures(self) -> PoseErrors:
        """Return root mean squares and the largest."""
        m, deg = self.distance, self.angle
        return PoseErrors(rms(m), float(m.max()), rms(deg), float(deg.max()))


def compared(truth: Trajectory, found: Trajectory) -> Compared:
    """Return how far poses are from true ones with the same stamps."""
    # Log(T^-1 T_true), whose translation is R^T (p_true - p) to first order in the rotation.
    R_back = found.R.transpose(0, 2, 1)
    turn = Rotation.from_matrix(R_back @ truth.R).as_rotvec()
    shift = np.einsum("nij,nj->ni", R_back, truth.p - found.p)
    return Compared(np.hstack([turn, shift]))


def check_truth(truth: Trajectory, drive: Trajectory, max_pose_gap_s: float, name: str) -> None:
    """Raise a SyncError, before any work is done, for a truth of another time."""
    if has_pose(truth, drive.stamp_ns, max_pose_gap_s).any():
        return
    (first, last), (start, end) = (1e-9 * each.stamp_ns[[0, -1]] for each in (truth, drive))
    raise SyncError(
        f"{name}: runs from {first:.3f} to {last:.3f} s, the drive from {start:.3f} to {end:.3f} "
        f"s, and no pose of it lies between two true ones that are {max_pose_gap_s:g} s apart at "
        "most; truth and bag need one clock"
    )


@dataclass(frozen=True)
class ComparedTrajectories:
    """What is compared with a truth, at the same key poses.

    Attributes
    ----------
    localised
        With covariances.
    odometry
        By odometry alone.
    by_scans
        By odometry and scans; None without scans.
    from_first
        Whether the first pose defines the frame of the others, as without a map: it is held, and
        its covariance says nothing of its errors in the frame of the truth.
    """

    localised: Trajectory
    odometry: Trajectory
    by_scans: Trajectory | None = None
    from_first: bool = False


def truth_record(
    truth: Trajectory, tested: ComparedTrajectories, max_pose_gap_s: float
) -> TruthRecord | None:
    """Return a localisation beside the truth; None if no key pose lies within it.

    Parameters
    ----------
    truth
        Poses of the lidar in the map, which are interpolated.
    tested
        Key poses.
    max_pose_gap_s
        Key poses between true ones further apart than this are not compared.
    """
    localised, odometry, by_scans = tested.localised, tested.odometry, tested.by_scans
    there = has_pose(truth, localised.stamp_ns, max_pose_gap_s)
    if not there.any():
        return None
    at = interpolated(truth, localised.stamp_ns[there])
    before, after = (compared(at, each[there]) for each in (odometry, localised))
    covariance = localised.covariance
    unknown = np.full(len(at), np.nan)
    squared = unknown if covariance is None else after.squared(covariance[there])
    if tested.from_first and there[0]:
        squared = np.append(np.nan, squared[1:])
    judged = squared[~np.isnan(squared)]
    path = np.full((len(there), 3), np.nan)
    path[there] = at.p
    return TruthRecord(
        poses=int(there.sum()),
        odometry=before.figures(),
        localised=after.figures(),
        by_scans=None if by_scans is None else compared(at, by_scans[there]).figures(),
        nees=float(judged.mean()) if len(judged) else float("nan"),
        beyond_95=float((judged > quantile(0.95, POSE_FREEDOM)).mean()) if len(judged) else 0.0,
        path=rows(path),
        odometry_m=row(_spread(before.distance, there)),
        localised_m=row(_spread(after.distance, there)),
        squared=row(_spread(squared, there), 3),
    )


def _spread(values: FloatArray, there: BoolArray) -> FloatArray:
    """Return values where there is a truth, and NaN elsewhere."""
    spread = np.full(len(there), np.nan)
    spread[there] = values
    return spread

r"""Key poses of a drive, odometry between them, and scans at the poses of odometry.

Where a recording states covariances of its poses that accumulate as odometry's do,
``P' = Ad P Ad^T + Q``, the step's covariance is Q. Otherwise it follows from distance and rotation.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import IDENTITY, between, isotropic_covariance, moved
from l2m_gtsam.lidar.odometry import LEAST_POINTS, ScanStep
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.recording.odometry_jumps import Jump, RepairedOdometry
from l2m_gtsam.recording.sync import has_pose, interpolated, twists
from l2m_gtsam.records.scans import Scan, taken_at_once
from l2m_gtsam.slam.drift import (
    DRIFT,
    drift_covariance,
    steady_share,
    steady_turn,
    steady_weights,
    stretched,
)
from l2m_gtsam.slam.options import DriftOptions, KeyPoseOptions, SlamOptions, StepAxes, Usage

# Rounding and interpolation may make eigenvalues of a step's covariance slightly negative.
ROUNDING = 1e-6
NEIGHBOURHOOD_NS = 1_000_000_000  # of odometry before and after a scan, for its motion


@dataclass(frozen=True)
class FixedStep:
    """A step whose odometry knows turn and shift about the axes of the first key pose.

    Attributes
    ----------
    turn
        Shape (3, 3).
    shift
        Metres, shape (3,).
    """

    turn: FloatArray
    shift: FloatArray


@dataclass(frozen=True)
class OdometrySteps:
    """Odometry from each key pose to the next.

    Attributes
    ----------
    R, p
        The next key pose in the frame of the one before, shapes (K - 1, 3, 3) and (K - 1, 3),
        metres.
    covariance
        Of a right perturbation of the step, rotation (rad) before translation (m), (K - 1, 6, 6).
    stated
        Whether the recording states these covariances.
    scale
        Standard deviation of a relative error that all lengths share; 0 for none.
    fixed_axes
        Steps along the axes of the first key pose in metres, shape (K - 1, 3), where odometry knows
        them along fixed axes; None where it knows them along those of the vehicle.
    steady
        What one standard deviation of a steady drift adds to each step along the axes of the frame
        of the poses, metres, shape (K - 1, 2, 3): of the drift that comes with time, and of that
        with distance. None for none.
    turning
        What one standard deviation of a steady turning adds to each step about the third axis of
        the frame of the poses, rad, shape (K - 1, 2), likewise. None for none.
    up_start
        The third axis of the frame of the poses, in the frame of the first key pose, shape (3,).
    """

    R: FloatArray
    p: FloatArray
    covariance: FloatArray
    stated: bool
    scale: float = 0.0
    fixed_axes: FloatArray | None = None
    steady: FloatArray | None = None
    turning: FloatArray | None = None
    up_start: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def __len__(self) -> int:
        return len(self.p)

    @cached_property
    def fixed_turns(self) -> FloatArray:
        """Turns about the axes of the first key pose, shape (K - 1, 3, 3)."""
        axes = [np.eye(3)]
        for turn in self.R:
            axes.append(axes[-1] @ turn)
        own = np.stack(axes)
        return np.asarray(own[1:] @ own[:-1].transpose(0, 2, 1))

    @cached_property
    def up(self) -> FloatArray:
        """The third axis of the frame of the poses, in that of each step's end, (K - 1, 3)."""
        axes = [self.up_start]
        for turn in self.R:
            axes.append(turn.T @ axes[-1])
        return np.reshape(axes[1:], (-1, 3))

    def drifts(self, up: FloatArray) -> FloatArray | None:
        """Return what a unit of each component of the steady drift adds to each step.

        Parameters
        ----------
        up
            The third axis of the frame of the poses, along the axes in which the result is: those
            of that frame, or, if a drift is as large along all, any.

        Returns
        -------
        FloatArray | None
            Rotation about that axis (rad) before translation (m), shape (K - 1, 6, 8); None where
            there is no such drift.
        """
        if self.steady is None and self.turning is None:
            return None
        found = np.zeros((len(self), 6, DRIFT))
        if self.steady is not None:
            for axis in range(3):
                found[:, 3 + axis, [axis, 3 + axis]] = self.steady[:, :, axis]
        if self.turning is not None:
            found[:, :3, 6:] = up[:, None] * self.turning[:, None]
        return found

    @property
    def path(self) -> FloatArray:
        """Path length from the start to each key pose in metres, shape (K,)."""
        return np.append(0.0, np.cumsum(np.linalg.norm(self.p, axis=1)))

    def until(self, count: int) -> "OdometrySteps":
        """Return so many first steps."""
        fixed = None if self.fixed_axes is None else self.fixed_axes[:count]
        return replace(
            self,
            R=self.R[:count],
            p=self.p[:count],
            covariance=self.covariance[:count],
            fixed_axes=fixed,
            steady=None if self.steady is None else self.steady[:count],
            turning=None if self.turning is None else self.turning[:count],
        )

    def as_walk(self, over_m: float) -> "OdometrySteps":
        """Return steps for solvers without variables that all steps share.

        Scale error and steady drift become independent noise of each step, with the same variance
        after ``over_m`` metres.
        """
        walked = self.with_scale_as_drift(over_m)
        drifts = walked.drifts(np.array([0.0, 0.0, 1.0]))
        if drifts is None:
            return walked
        length = np.linalg.norm(self.p, axis=1)
        # Per metre at the drive's mean speed, both kinds together.
        total = float(length.sum())
        share = np.linalg.norm(drifts.sum(axis=0), axis=1) / total if total else np.zeros(6)
        turned, along, vertical = share[[2, 3, 5]] ** 2
        shape = stretched(self.up, vertical / along if along else 1.0)
        covariance, walk = walked.covariance.copy(), (over_m * length)[:, None, None]
        covariance[:, :3, :3] += turned * walk * self.up[:, :, None] * self.up[:, None]
        covariance[:, 3:, 3:] += along * walk * shape
        return replace(walked, covariance=covariance, steady=None, turning=None)

    def with_scale_as_drift(self, over_m: float) -> "OdometrySteps":
        """Return steps for solvers without a scale variable.

        The scale error becomes independent noise of each step along its direction, a random walk
        that has the same variance after ``over_m`` metres.
        """
        length = np.linalg.norm(self.p, axis=1)[:, None]
        along = np.einsum("nji,nj->ni", self.R, self.p) / np.maximum(length, np.finfo(float).tiny)
        covariance = self.covariance.copy()
        # n steps of length l: n s^2 L l = (s L)^2 where n l = L, the variance of the scale error.
        sigma = self.scale * np.sqrt(over_m * length) * along
        covariance[:, 3:, 3:] += sigma[:, :, None] * sigma[:, None]
        return replace(self, covariance=covariance, scale=0.0)


def key_pose_rows(trajectory: Trajectory, options: KeyPoseOptions) -> IntArray:
    """Return the rows of a trajectory's key poses, shape (K,), the first and last among them.

    Distance and rotation are those from the last key pose, not summed over the poses between: the
    noise of a parked vehicle makes no key poses.
    """
    rows, least = [0], np.cos(np.deg2rad(options.angle_deg))
    for row in range(1, len(trajectory)):
        last = rows[-1]
        distance = np.linalg.norm(trajectory.p[row] - trajectory.p[last])
        turned = (np.sum(trajectory.R[row] * trajectory.R[last]) - 1) / 2 <= least
        if distance >= options.distance_m or turned:
            rows.append(row)
    if rows[-1] != len(trajectory) - 1:
        rows.append(len(trajectory) - 1)
    return np.array(rows)


def with_rows_at(rows: IntArray, trajectory: Trajectory, stamp_ns: IntArray) -> IntArray:
    """Return rows of key poses, with those of the poses nearest to some times."""
    after = np.clip(np.searchsorted(trajectory.stamp_ns, stamp_ns), 1, len(trajectory) - 1)
    early, late = trajectory.stamp_ns[after - 1], trajectory.stamp_ns[after]
    return np.union1d(rows, after - (stamp_ns - early < late - stamp_ns))


def odometry_steps(
    trajectory: Trajectory, rows: IntArray, options: DriftOptions, jumps: Sequence[Jump] = ()
) -> OdometrySteps:
    """Return odometry's steps between key poses.

    Parameters
    ----------
    trajectory
        Odometry, M poses.
    rows
        Rows of the key poses in it, shape (K,).
    options
        Drift of odometry.
    jumps
        Those removed from the trajectory; the poses before and after each are key poses.
    """
    R_back = trajectory.R[rows[:-1]].transpose(0, 2, 1)
    R = R_back @ trajectory.R[rows[1:]]
    p = np.einsum("nij,nj->ni", R_back, np.diff(trajectory.p[rows], axis=0))
    fixed = None
    if options.axes is StepAxes.FIXED:
        fixed = np.diff(trajectory.p[rows], axis=0) @ trajectory.R[rows[0]]
    stated = _stated(trajectory, rows, R, p) if options.stated is Usage.USED else None
    if stated is not None:  # the repair of jumps has put their covariance into the poses'
        covariance = stated + isotropic_covariance(options.least_deg, options.least_m)
    else:
        covariance = drift_covariance(R, p, options, trajectory.R[rows[1:], 2])
        for jump in jumps:
            covariance[np.searchsorted(rows, jump.row)] += jump.covariance
    seconds = 1e-9 * np.diff(trajectory.stamp_ns[rows])
    share, turn = steady_share(options, is_stated=stated is not None), steady_turn(options)
    return OdometrySteps(
        R,
        p,
        covariance,
        stated=stated is not None,
        scale=options.scale,
        fixed_axes=fixed,
        steady=steady_weights(seconds, p, share) if share.any() else None,
        turning=steady_weights(seconds, p, turn)[:, :, 0] if turn.any() else None,
        up_start=trajectory.R[rows[0], 2],
    )


def _stated(
    trajectory: Trajectory, rows: IntArray, R: FloatArray, p: FloatArray
) -> FloatArray | None:
    """Return the steps' covariances if those of the poses accumulate, shape (K - 1, 6, 6)."""
    if trajectory.covariance is None:
        return None
    P = trajectory.covariance[rows]
    steps = zip(P[:-1], P[1:], R, p, strict=True)
    Q = [after - moved(before[None], RigidTransform(*step))[0] for before, after, *step in steps]
    values, vectors = np.linalg.eigh(np.reshape(Q, (-1, 6, 6)))
    floor = ROUNDING * np.abs(P[1:]).max(axis=(1, 2), initial=0.0)
    if not np.any(values > floor[:, None]) or np.any(values < -floor[:, None]):
        return None
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ vectors.swapaxes(1, 2))


def scan_odometry(
    scans: Iterable[Scan], repaired: RepairedOdometry, edge: float, options: SlamOptions
) -> Iterator[ScanStep]:
    """Yield the scans with enough points and a pose of odometry, each with that pose.

    Parameters
    ----------
    scans
        In order of time.
    repaired
        Poses of the vehicle by odometry, in the same clock, without its jumps.
    edge
        Cell size in metres; scans are thinned to one point per cell.
    options
        Longest gap of odometry that is interpolated, and its drift.
    """
    last: RigidTransform | None = None
    last_ns = 0
    for scan in scans:
        at = np.array([scan.stamp_ns], dtype=np.int64)
        near = _around(repaired.trajectory, scan.stamp_ns)
        if len(scan) < LEAST_POINTS or not has_pose(near, at, options.max_pose_gap_s)[0]:
            continue
        here = interpolated(near, at).pose(0)
        step = IDENTITY if last is None else between(last, here)
        up = here.R[2][None]
        covariance = drift_covariance(step.R[None], step.t[None], options.drift, up)[0]
        if last is not None:
            covariance += _jumps_between(repaired, last_ns, scan.stamp_ns)
        surface = Surface(taken_at_once(scan, twists(near, at)[0]), edge)
        yield ScanStep(scan.stamp_ns, here, step, covariance, surface, believed=True)
        last, last_ns = here, scan.stamp_ns


def _jumps_between(repaired: RepairedOdometry, first_ns: int, last_ns: int) -> FloatArray:
    """Return what jumps between two times add to a step's covariance, shape (6, 6)."""
    stamps = repaired.trajectory.stamp_ns
    return sum(
        (
            each.covariance
            for each in repaired.jumps
            if stamps[each.row] < last_ns and stamps[each.row + 1] > first_ns
        ),
        start=np.zeros((6, 6)),
    )


def _around(trajectory: Trajectory, stamp_ns: int) -> Trajectory:
    """Return the poses about a time, two at least."""
    ends = np.array([stamp_ns - NEIGHBOURHOOD_NS, stamp_ns + NEIGHBOURHOOD_NS])
    first, last = np.searchsorted(trajectory.stamp_ns, ends)
    first = int(np.clip(first - 1, 0, max(len(trajectory) - 2, 0)))
    rows: IntArray = np.arange(first, min(max(int(last) + 1, first + 2), len(trajectory)))
    return trajectory[rows]

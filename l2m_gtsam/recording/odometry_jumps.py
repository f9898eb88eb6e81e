"""Jumps of odometry: steps unlike the motion around them, detected and removed. Pure arrays.

From one pose to the next a vehicle moves as just before and just after, up to its acceleration. A
slipping wheel, a wrong scan match or a reset origin makes a step that differs by more: the motion
of its neighbours replaces it, and all later poses are moved rigidly. A short pivot or a kerb may
look the same; the recorded step is kept, for whoever has evidence (``slam.slips``).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from l2m_gtsam.data import BoolArray, FloatArray, IntArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import between, carried_back, compose, moved
from l2m_gtsam.options import Options
from l2m_gtsam.recording.step_motion import (
    AXES,
    NEIGHBOURS,
    MotionAbout,
    Steps,
    changes_among,
    motion_about,
    steps_of,
)

LEAST_STEPS = 4  # drives of fewer steps have no jumps
ROUNDS = 20  # limit of detections without the jumps found before: a few are needed
MAX_REPORTED = 3  # jumps that are reported one by one
GRADES = 4  # of lengths of gaps, for each doubling
USUAL = 0.98  # share of a drive's accelerations; jumps are among the others


class JumpOptions(Options):
    """Which steps of odometry are unlike the motion around them.

    A step is compared with the median motion of three steps before and three after. It is a jump
    if it differs by more than all of these.
    """

    position_m: float = Field(default=0.05, gt=0)
    """Metres, or"""
    rotation_deg: float = Field(default=3.0, gt=0)
    """degrees."""
    acceleration_m_s2: float = Field(default=4.0, gt=0)
    """What the vehicle may accelerate by in m/s^2, over the time of the step and from there to its
    neighbours; more where half of the drive does, as what is carried by hand may,"""
    acceleration_deg_s2: float = Field(default=300.0, gt=0)
    """and how its turning may change in deg/s^2, likewise."""
    accelerations: float = Field(default=5.0, ge=1)
    """So many times what nearly all of the drive's own accelerations are within, where that is
    less; not over gaps."""
    gaps: float = Field(default=2.0, ge=1)
    """Over a gap of poses, off line: so many times what the drive's own motion differs by from that
    around it over as long a time, nearly always. A hand turns more suddenly than a vehicle."""
    scatter: float = Field(default=10.0, ge=1)
    """So many times what half of the drive's own steps differ by: the noise of the poses."""


@dataclass(frozen=True)
class Jump:
    """A step of odometry that was replaced by the motion of its neighbours.

    Attributes
    ----------
    row
        Row of the pose before it in the repaired trajectory.
    seconds
        Time of its end since the first pose.
    distance_m, angle_deg
        Difference between the step and its replacement.
    covariance
        Of a right perturbation of the replacement, rotation (rad) before translation (m), shape
        (6, 6), by the differences of the drive's other steps from their neighbours.
    recorded
        The step as odometry has it: the pose after in the frame of the pose before.
    """

    row: int
    seconds: float
    distance_m: float
    angle_deg: float
    covariance: FloatArray
    recorded: RigidTransform

    def __str__(self) -> str:
        return (
            f"odometry jumps by {self.distance_m:.2f} m and {self.angle_deg:.1f} deg "
            f"{self.seconds:.1f} s after its first pose: the motion before and after replaces it"
        )


@dataclass(frozen=True)
class RepairedOdometry:
    """A trajectory without jumps.

    Attributes
    ----------
    trajectory
        The remaining poses, with jumps replaced.
    jumps
        Replaced steps, in order of time.
    left_out
        Number of isolated poses that were removed.
    """

    trajectory: Trajectory
    jumps: tuple[Jump, ...]
    left_out: int

    @property
    def rows(self) -> IntArray:
        """Rows of the poses before and after jumps, ascending."""
        before = np.array([each.row for each in self.jumps], dtype=np.int64)
        return np.union1d(before, before + 1)

    def notes(self) -> tuple[str, ...]:
        """Return how many isolated poses were removed, if any, as a sentence."""
        if not self.left_out:
            return ()
        note = (
            "isolated poses of odometry, far from those before and after, are left out: "
            f"{self.left_out}"
        )
        return (note,)


def jump_notes(jumps: Sequence[Jump]) -> tuple[str, ...]:
    """Return a sentence on each of a few jumps, and how many more there are."""
    notes = [str(each) for each in jumps[:MAX_REPORTED]]
    if len(jumps) > MAX_REPORTED:
        notes.append(f"odometry jumps {len(jumps) - MAX_REPORTED} more times")
    return tuple(notes)


def without_jumps(trajectory: Trajectory, options: JumpOptions) -> RepairedOdometry:
    """Return odometry without its jumps; as it is where it has none.

    Covariances of poses still accumulate from the first pose: that of the replacement takes the
    place of what the trajectory states for the step that jumped.

    Parameters
    ----------
    trajectory
        Poses of odometry.
    options
        What is a jump.
    """
    if len(trajectory) <= LEAST_STEPS:
        return RepairedOdometry(trajectory, (), 0)
    kept = np.arange(len(trajectory))
    for _ in range(ROUNDS):
        part = trajectory[kept]
        found = _jumps_among(part, options)
        # A pose between two consecutive jumps belongs to neither side.
        stray = np.flatnonzero(found.jumped[:-1] & found.jumped[1:]) + 1
        if not len(stray):
            break
        kept = np.delete(kept, stray[::2])
    jumps = tuple(_jump(part, found, int(row)) for row in np.flatnonzero(found.jumped))
    repaired = _repaired(part, found, jumps) if jumps else part
    return RepairedOdometry(repaired, jumps, len(trajectory) - len(part))


@dataclass(frozen=True)
class _StepComparison:
    """What is expected of N steps, and which are jumps.

    Attributes
    ----------
    motion
        The motion about each.
    reach
        Time of each times that to its neighbours, s^2, shape (N,).
    acceleration
        Mean square per axis from one good step to the next, rad^2/s^4 and m^2/s^4, shape (2,).
    jumped
        Which differ too much, shape (N,).
    """

    motion: MotionAbout
    reach: FloatArray
    acceleration: FloatArray
    jumped: BoolArray


def _jumps_among(trajectory: Trajectory, options: JumpOptions) -> _StepComparison:
    """Detect jumps, repeated without those found before until they are the same."""
    steps = steps_of(trajectory)
    jumped = np.zeros(len(steps.seconds), dtype=np.bool_)
    # Once: with what is found later the drive's own motion would depend on what it decides.
    first = _compared(steps, ~jumped, options).jumped
    usual = _usual_over_gaps(trajectory, steps, first, options)
    for _ in range(ROUNDS):
        found = _compared(steps, ~jumped, options, usual)
        if 2 * found.jumped.sum() >= len(found.jumped):  # no reference motion
            return replace(found, jumped=np.zeros_like(jumped))
        if np.array_equal(found.jumped, jumped):
            break
        jumped = found.jumped
    return found


def _compared(
    steps: Steps, good: BoolArray, options: JumpOptions, usual: FloatArray | float = 0.0
) -> _StepComparison:
    """Compare N steps with their good neighbours; ``usual`` never is a jump, shape (N, 2)."""
    motion = motion_about(steps, good)
    reach, changes = steps.seconds * motion.away, changes_among(steps, good)
    # Mean squares per axis.
    acceleration = np.asarray(np.mean(changes**2, axis=0) / AXES)
    sizes = motion.sizes()
    limits = np.maximum(
        np.array([np.deg2rad(options.rotation_deg), options.position_m]),
        options.scatter * np.median(sizes, axis=0),
    )
    most = np.array([np.deg2rad(options.acceleration_deg_s2), options.acceleration_m_s2])
    half, own = np.quantile(changes, [0.5, USUAL], axis=0)
    within = np.minimum(np.maximum(most, half), options.accelerations * own)
    acceptable = np.where(steps.is_gap[:, None], most, within)
    limits = np.maximum(np.maximum(limits, reach[:, None] * acceptable), usual)
    return _StepComparison(motion, reach, acceleration, np.any(sizes > limits, axis=1))


def _usual_over_gaps(
    trajectory: Trajectory, steps: Steps, jumped: BoolArray, options: JumpOptions
) -> FloatArray:
    """Return what a drive's own motion may differ by over each of its gaps that looks like a jump.

    Parameters
    ----------
    trajectory, steps
        N poses, and the steps between them.
    jumped
        Which steps look like jumps, shape (N - 1,).
    options
        What is a jump.

    Returns
    -------
    Radians and metres, shape (N - 1, 2); 0 for all other steps.
    """
    usual, period, gap = np.zeros((len(jumped), 2)), steps.period, steps.is_gap
    suspect = np.flatnonzero(gap & jumped)
    # About so many periods: gaps of much the same length are compared with the same motion.
    lost = np.exp2(np.ceil(GRADES * np.log2(steps.seconds[suspect] / period)) / GRADES)
    for periods in np.unique(lost).tolist():
        own = _own_motion(trajectory, ~(gap | jumped), round(periods), period)
        usual[suspect[lost == periods]] = options.gaps * own
    return usual


def _own_motion(trajectory: Trajectory, good: BoolArray, count: int, period: float) -> FloatArray:
    """Return what nearly all of a drive's motion over a time differs by from that around it.

    Poses are left out, as in a gap, wherever the drive has them.

    Parameters
    ----------
    trajectory
        N poses.
    good
        Which steps between them are neither gaps nor like jumps, shape (N - 1,).
    count, period
        So many usual times of a step, and that time in seconds.

    Returns
    -------
    Radians and metres, shape (2,); 0 where the drive is nowhere long enough.
    """
    place = np.arange(len(trajectory)) % (count + NEIGHBOURS)
    kept = np.flatnonzero((place == 0) | (place >= count))
    part = trajectory[kept]
    wrong = np.diff(np.append(0, np.cumsum(~good))[kept]) > 0
    steps = steps_of(part)
    # Stamps that come in bursts make so many steps much shorter or longer.
    lasting = np.abs(steps.seconds - count * period) < 0.5 * count * period
    chosen = lasting & (np.diff(kept) == count) & ~wrong
    if not chosen.any():
        return np.zeros(2)
    sizes = motion_about(steps, ~wrong).sizes()[chosen]
    largest = np.quantile(sizes, USUAL, axis=0)
    return np.asarray(np.nan_to_num(largest))  # NaN without neighbours


def _jump(trajectory: Trajectory, found: _StepComparison, row: int) -> Jump:
    angle, distance = found.motion.sizes()[row].tolist()
    variance = found.acceleration * found.reach[row] ** 2
    return Jump(
        row=row,
        seconds=1e-9 * float(trajectory.stamp_ns[row + 1] - trajectory.stamp_ns[0]),
        distance_m=distance,
        angle_deg=float(np.rad2deg(angle)),
        covariance=np.diag(np.repeat(variance, 3)),
        recorded=between(
            *(RigidTransform(trajectory.R[k], trajectory.p[k]) for k in (row, row + 1))
        ),
    )


def _repaired(
    trajectory: Trajectory, found: _StepComparison, jumps: tuple[Jump, ...]
) -> Trajectory:
    """Replace jumps by the motion of their neighbours, and move all later poses rigidly."""
    R, p = trajectory.R.copy(), trajectory.p.copy()
    stated = trajectory.covariance
    covariance = None if stated is None else stated.copy()
    ends = [*(each.row + 1 for each in jumps[1:]), len(trajectory)]
    for jump, end in zip(jumps, ends, strict=True):
        k = jump.row
        step = RigidTransform(found.motion.R[k], found.motion.t[k])
        first = compose(RigidTransform(R[k], p[k]), step)
        own = RigidTransform(trajectory.R[k + 1], trajectory.p[k + 1])
        later = slice(k + 1, end)
        carry = compose(first, own.inverse())
        R[later] = carry.R @ trajectory.R[later]
        p[later] = trajectory.p[later] @ carry.R.T + carry.t
        if covariance is not None and stated is not None:
            more = moved(covariance[k][None], step)[0] + jump.covariance - stated[k + 1]
            back = _from(own, trajectory, later)
            covariance[later] = stated[later] + back @ more @ back.transpose(0, 2, 1)
    return replace(trajectory, R=R, p=p, covariance=covariance)


def _from(first: RigidTransform, trajectory: Trajectory, later: slice) -> FloatArray:
    """Return what an error of a pose makes of later ones, shape (K, 6, 6)."""
    R, p = trajectory.R[later], trajectory.p[later]
    return carried_back(first.R.T @ R, (p - first.t) @ first.R)

r"""Whether a jump of odometry is a slip or motion: judged by readings and scans.

A step unlike the motion around it may be a slip of the wheels, or a pivot that took one step. For
each there is a recorded step and one that continues the motion, ``d`` apart. The drive is solved
with the middle of both as the step, uncertain along ``d``:

    z = z_continued Exp(d / 2)        covariance Q + s^2 d d^T

so that all other measurements determine how far along ``d`` the poses moved. With the posterior
mean m and variance v of that share (-1/2: as continued, 1/2: as recorded), the ratio of the
likelihoods of both ends is, for a normal prior around the middle,

    log p(recorded) - log p(continued) = m / v

for the prior is the same at both. Where both are so far apart that fields between them say nothing
about either, the likelihoods of the whole drive with one and with the other are compared, where a
solver gives them; otherwise no vehicle makes the recorded step: it is a slip.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.recording.odometry_jumps import Jump, jump_notes
from l2m_gtsam.slam.drive import Drive, OdometryJump, as_pose
from l2m_gtsam.slam.solution import DriveSolution

# Log odds that a step unlike the motion around it is a slip, before any reading: 20 to 1.
SLIPPED = 3.0
FAR_M, FAR_DEG = 0.3, 45.0  # between a recorded step and a continued one
MOST_FAR = 10  # jumps with ends far apart; odometry with more has slips
OPEN = 1.0  # standard deviation of the share of the difference; both ends are half of one away


@dataclass(frozen=True)
class JudgedOdometry:
    """A drive whose jumps are decided.

    Attributes
    ----------
    drive
        With the believed steps; its jumps are the slips alone.
    notes
        On the slips.
    """

    drive: Drive
    notes: tuple[str, ...]


def judged(
    drive: Drive,
    solve: Callable[[Drive], DriveSolution],
    likelihood: Callable[[Drive], float] | None = None,
) -> JudgedOdometry:
    """Decide which jumps of odometry are slips.

    Parameters
    ----------
    drive
        Its steps continue the motion where odometry jumps.
    solve
        Solves a drive, here with the steps at jumps open.
    likelihood
        Log likelihood of a drive's readings given its odometry. Without it jumps whose ends are far
        apart are slips.
    """
    far = [each for each in drive.jumps if is_far(each.jump)]
    moved = set[int]() if likelihood is None else far_motions(drive, far, likelihood)
    drive = drive.as_recorded([each for each in far if each.step in moved])
    open_jumps = [each for each in drive.jumps if not is_far(each.jump)]
    if open_jumps:
        doubtful = replace(drive, jumps=tuple(open_jumps))
        evidence = motion_evidence(doubtful, solve(with_open_jumps(doubtful)))
        moved |= {
            jump.step for jump, odds in zip(open_jumps, evidence, strict=True) if odds > SLIPPED
        }
    slipped = tuple(each for each in drive.jumps if each.step not in moved)
    recorded = drive.as_recorded([each for each in open_jumps if each.step in moved])
    notes = jump_notes([each.jump for each in slipped])
    return JudgedOdometry(replace(recorded, jumps=slipped), notes)


def far_motions(
    drive: Drive, far: list[OdometryJump], likelihood: Callable[[Drive], float]
) -> set[int]:
    """Return the steps of jumps with ends far apart that are motion, as after a gap of the poses.

    One after the other, from all as recorded: each is a slip if readings are likelier without it.
    Where they say nothing the odometry stays as it is.
    """
    moved = {each.step: each for each in far[:MOST_FAR]}
    best = likelihood(drive.as_recorded(list(moved.values()))) if moved else 0.0
    for step in list(moved):
        others = {key: each for key, each in moved.items() if key != step}
        without = likelihood(drive.as_recorded(list(others.values())))
        if without - best > SLIPPED:
            moved, best = others, without
    return set(moved)


def is_far(jump: Jump) -> bool:
    """Return whether a recorded step is so far from the continued one that it is no motion."""
    return jump.distance_m > FAR_M or jump.angle_deg > FAR_DEG


def with_open_jumps(drive: Drive) -> Drive:
    """Return a drive whose steps at jumps may be anything from continued to recorded."""
    steps = drive.steps
    R, p, covariance = steps.R.copy(), steps.p.copy(), steps.covariance.copy()
    for each in drive.jumps:
        if is_far(each.jump):
            continue
        d = difference(drive, each)
        middle = drive.step(each.step).compose(gtsam.Pose3.Expmap(d / 2))
        R[each.step], p[each.step] = middle.rotation().matrix(), middle.translation()
        covariance[each.step] += OPEN**2 * np.outer(d, d)
    return replace(drive, steps=replace(steps, R=R, p=p, covariance=covariance))


def with_recorded_jumps(drive: Drive) -> Drive:
    """Return a drive with all steps as recorded, uncertain by what slips would make of them."""
    recorded = drive.as_recorded(drive.jumps)
    covariance = recorded.steps.covariance.copy()
    for each in drive.jumps:
        d = difference(drive, each)
        covariance[each.step] += np.outer(d, d)
    return replace(recorded, steps=replace(recorded.steps, covariance=covariance))


def difference(drive: Drive, jump: OdometryJump) -> FloatArray:
    """Return by what a recorded step differs from the continued motion, rad and m, shape (6,)."""
    step = drive.step(jump.step)
    return np.asarray(gtsam.Pose3.Logmap(step.between(as_pose(jump.jump.recorded))))


def motion_evidence(drive: Drive, solution: DriveSolution) -> FloatArray:
    """Return the log likelihood ratio of motion to slip for each jump, shape (J,).

    Parameters
    ----------
    drive
        Its steps continue the motion.
    solution
        Of the drive with open jumps.
    """
    opened = solution.drive.steps
    ratio = np.zeros(len(drive.jumps))
    for i, jump in enumerate(drive.jumps):
        k, d = jump.step, difference(drive, jump)
        one, two = solution.poses[k], solution.poses[k + 1]
        motion = one.between(two)
        open_step = gtsam.Pose3(gtsam.Rot3(opened.R[k]), opened.p[k])
        e = gtsam.Pose3.Logmap(open_step.between(motion))
        # Right perturbations of both poses to one of the motion between them.
        J = np.hstack([-motion.inverse().AdjointMap(), np.eye(6)])
        P = J @ solution.step_covariance[i] @ J.T
        # Of the share given the motion, by its prior and the rest of the step's error.
        gain = OPEN**2 * np.linalg.solve(opened.covariance[k], d)
        variance = OPEN**2 * (1 - d @ gain) + gain @ P @ gain
        ratio[i] = gain @ e / variance
    return ratio

"""Whether a step of odometry is the motion of a vehicle, judged as it comes.

Off line a step is compared with those before and after it (:mod:`l2m_gtsam.recording.\
odometry_jumps`); here those after are not known. A step that the motion before does not explain may
be a slip or motion: it counts as uncertain by its whole difference ``d`` from the motion before,
``covariance + d d^T``, so that readings decide. Over a gap the vehicle may have gone on while
odometry did not, and may have turned: there it is as uncertain along all axes; or odometry was
silent alone, and its step is right.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import isotropic_covariance
from l2m_gtsam.slam.drive import as_pose, as_transform
from l2m_gtsam.slam.online.events import EventKind
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.slips import FAR_DEG, FAR_M

NS = 1e-9
STOOD_STILL = 0.5  # share of the expected path, below which odometry has not gone on
NEIGHBOURS = 2.0  # steps over which the vehicle may have accelerated since the motion before


@dataclass(frozen=True)
class SuspectStep:
    """A step that is no usual motion.

    Attributes
    ----------
    kind, text
        To report.
    end
        What the pose at its end is taken to be, in the frame of odometry.
    covariance
        Added to the step's, shape (6, 6).
    lost
        Whether the vehicle may be anywhere near: it had moved, and odometry stood still.
    doubtful
        Whether the step may as well be as recorded, with no more than its stated error.
    """

    kind: EventKind
    text: str
    end: RigidTransform
    covariance: FloatArray
    lost: bool = False
    doubtful: bool = False


def velocity(before: OdometryPose, after: OdometryPose) -> FloatArray:
    """Return the velocity from one pose to another, rad/s and m/s along the vehicle's axes."""
    seconds = NS * (after.stamp_ns - before.stamp_ns)
    return np.asarray(gtsam.Pose3.Logmap(as_pose(before.T).between(as_pose(after.T)))) / seconds


def suspect_step(
    before: OdometryPose, after: OdometryPose, motion: FloatArray, options: SlamOptions
) -> SuspectStep | None:
    """Return what is to be made of a step, if it is no usual motion.

    Parameters
    ----------
    before, after
        Its poses.
    motion
        Velocity until then, as of ``velocity``; NaN where it is unknown.
    options
        Longest gap, and what is a jump.
    """
    seconds = NS * (after.stamp_ns - before.stamp_ns)
    gap = seconds > options.max_pose_gap_s
    known = bool(np.isfinite(motion).all())
    if not known and not gap:
        return None
    step = as_pose(before.T).between(as_pose(after.T))
    expected = gtsam.Pose3.Expmap(seconds * (motion if known else np.zeros(6)))
    d = np.asarray(gtsam.Pose3.Logmap(expected.between(step)))
    turn, shift = float(np.rad2deg(np.linalg.norm(d[:3]))), float(np.linalg.norm(d[3:]))
    jumps, reach = options.jumps, NEIGHBOURS * seconds**2
    most_deg = max(jumps.rotation_deg, jumps.acceleration_deg_s2 * reach)
    most_m = max(jumps.position_m, jumps.acceleration_m_s2 * reach)
    if gap:
        # A turn that had just begun need not go on: the way that was due counts, wherever it led.
        due = seconds * float(np.linalg.norm(motion[3:])) if known else 0.0
        gone = float(np.linalg.norm(step.translation()))
        shift = max(shift, due - gone)
        text = (
            f"odometry has a gap of {seconds:.1f} s: readings in it are left out, and the step "
            f"over it may be off by {shift:.2f} m and {turn:.1f} deg, by which the motion before "
            "differs"
        )
        far = shift > FAR_M or turn > FAR_DEG
        lost = shift > FAR_M and gone < STOOD_STILL * due
        covariance = isotropic_covariance(turn, shift)
        doubtful = far and not lost
        return SuspectStep(EventKind.ODOMETRY_GAP, text, after.T, covariance, lost, doubtful)
    if turn <= most_deg and shift <= most_m:
        return None
    if shift > FAR_M or turn > FAR_DEG:
        text = (
            f"odometry jumps by {shift:.2f} m and {turn:.1f} deg: the motion before goes on, the "
            "step is as uncertain"
        )
        end = as_pose(before.T).compose(expected)
        T = as_transform(end)
        covariance = isotropic_covariance(most_deg, most_m) + np.outer(d, d)
        return SuspectStep(EventKind.ODOMETRY_JUMP, text, T, covariance, doubtful=True)
    text = (
        f"odometry jumps by {shift:.2f} m and {turn:.1f} deg: a slip or a pivot, the step is as "
        "uncertain"
    )
    return SuspectStep(EventKind.ODOMETRY_JUMP, text, after.T, np.outer(d, d))

"""Steps of odometry as they come: which are no usual motion, and what they may be."""

import gtsam
import numpy as np
import pytest

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.slam.drive import as_transform
from l2m_gtsam.slam.online.odometry_check import SuspectStep, suspect_step
from l2m_gtsam.slam.online.odometry_pose import OdometryPose
from l2m_gtsam.slam.options import SlamOptions

STILL = RigidTransform(np.eye(3), np.zeros(3))


def over_gap(motion: FloatArray, T: RigidTransform, seconds: float = 4.0) -> SuspectStep:
    """Return what is made of a step, after a motion in rad/s and m/s."""
    end = OdometryPose(round(1e9 * seconds), T)
    found = suspect_step(OdometryPose(0, STILL), end, motion, SlamOptions())
    assert found is not None
    return found


@pytest.mark.parametrize("turning", [0.0, 1.5])
def test_odometry_that_stood_still_is_lost_whether_the_vehicle_turned(turning: float) -> None:
    """A turn that goes on would end where it began: the way of 2.4 m is due all the same."""
    found = over_gap(np.array([0.0, 0.0, turning, 0.6, 0.0, 0.0]), STILL)
    assert found.lost
    assert not found.doubtful
    assert np.sqrt(found.covariance[3, 3]) >= 2.4


def test_a_step_is_in_doubt_where_it_is_far_from_the_motion_before() -> None:
    motion = np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.0])
    near = gtsam.Pose3(gtsam.Rot3.Yaw(0.1), np.array([2.3, 0.1, 0.0]))
    far = gtsam.Pose3(gtsam.Rot3.Yaw(1.5), np.array([1.6, 1.0, 0.0]))
    assert not over_gap(motion, as_transform(near)).doubtful
    assert over_gap(motion, as_transform(far)).doubtful

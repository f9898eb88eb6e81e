"""What knots of pose errors leave open."""

from l2m_gtsam.calibration.pose_errors import PoseKnots
from l2m_gtsam.data import FloatArray


def left_open(knots: PoseKnots, seconds: FloatArray) -> FloatArray:
    """Covariance of the errors at times of one segment beside what the knots say of them."""
    return knots.left(seconds, knots.weights(seconds), knots.at_knots(seconds))

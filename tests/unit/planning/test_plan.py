"""What an extra motion adds to the readings of a drive."""

import numpy as np

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.planning.motion import ExtraMotion
from l2m_gtsam.planning.plan import with_motion

STAMPS = np.arange(5) * 100_000_000
SECONDS = np.arange(3.0)
TURN = ExtraMotion("turn", np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)), SECONDS)


def readings(numbers: FloatArray | None) -> Readings:
    """Return five of one sensor."""
    R, p = np.tile(np.eye(3), (5, 1, 1)), np.zeros((5, 3))
    return Readings(("a",), np.zeros(5, int), STAMPS, R, p, np.zeros((5, 3)), regressors=numbers)


def test_recorded_numbers_of_a_motion_are_the_means_of_the_drive() -> None:
    """Without them a plan would know nothing of the numbers of the drive, either."""
    numbers = np.array([[4.0, 0.0], [5.0, 1.0], [6.0, 0.0], [5.0, 1.0], [5.0, 0.5]])
    both = with_motion(readings(numbers), TURN)
    assert both.regressors is not None
    np.testing.assert_array_equal(both.regressors[:5], numbers)
    np.testing.assert_allclose(both.regressors[5:], np.tile([5.0, 0.5], (3, 1)))
    assert with_motion(readings(None), TURN).regressors is None

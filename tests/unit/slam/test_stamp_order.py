"""Which of two stamps is wrong: closed answers."""

import numpy as np
import pytest

from l2m_gtsam.slam.online.stamp_order import Held, decided


@pytest.mark.parametrize(
    ("held", "following", "before", "expected"),
    [
        (30, 31, 10, Held.COUNTS),  # after a gap, and others after it
        (30, None, 10, Held.COUNTS),  # the last of a drive
        (30, 21, 10, Held.IS_AHEAD),
        (12, 13, 10, Held.LAST_IS_AHEAD),
        (12, 13, -np.inf, Held.LAST_IS_AHEAD),
        (12, 13, np.inf, Held.IS_LATE),  # the last is a key pose
        (12, None, 10, Held.IS_LATE),  # nothing shows that the last is wrong
        (12, 21, 10, Held.IS_LATE),
        (9, 12, 10, Held.IS_LATE),  # older than the one before the last, too
        (12, 11, 10, Held.IS_LATE),
    ],
)
def test_the_next_stamp_decides(
    held: int, following: int | None, before: float, expected: Held
) -> None:
    """The last message that counted is of 20."""
    assert decided(held, following, 20, before) is expected

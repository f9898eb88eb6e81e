"""SLAM without a map where steel is moved between two laps. Long: `make study` runs it."""

import pytest

from tests.drives.exploring import explored
from tests.drives.moved_steel import moved_steel
from tests.support.pose_errors import pose_nees, position_error

pytestmark = pytest.mark.study

WITHIN = 1.5  # times the error of the same drive without the move
LARGEST_NEES = 12  # twice the six of one pose: poses of one drive err together


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 7])
def test_laps_close_though_steel_was_moved(seed: int) -> None:
    drives = moved_steel(seed)
    still, moved = (
        explored(each, drives.sensors).result.trajectory for each in (drives.still, drives.moved)
    )
    truth = drives.still.truth
    before, after = position_error(truth, still), position_error(truth, moved)
    assert after < WITHIN * before, f"{before:.3f} m without the move, {after:.3f} m with it"
    for each in (still, moved):
        assert pose_nees(truth, each).mean() < LARGEST_NEES

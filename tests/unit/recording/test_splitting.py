"""A drive in two parts."""

import numpy as np
import pytest

from l2m_gtsam.data import FieldSeries, Recording, ScalarSeries, SourceFile, Trajectory
from l2m_gtsam.recording.splitting import split_at

STAMPS = np.arange(10) * 10**9


@pytest.mark.parametrize("stamp_ns", [-1, 0, 4 * 10**9, 4 * 10**9 + 1, 10**12])
def test_each_row_is_in_one_part(stamp_ns: int) -> None:
    poses = Trajectory(STAMPS, np.tile(np.eye(3), (10, 1, 1)), np.eye(10)[:, :3], "map", "lidar")
    field = np.arange(30.0).reshape(10, 3)
    whole = Recording(
        poses,
        (FieldSeries("mag", "/mag", "mag", STAMPS + 5, field),),
        SourceFile("drive", ""),
        (ScalarSeries("motor", "/motor", STAMPS - 5, np.arange(10.0)),),
    )
    before, after = split_at(whole, stamp_ns)
    assert all((each < stamp_ns).all() for each in (before.trajectory.stamp_ns,))
    assert all((each >= stamp_ns).all() for each in (after.trajectory.stamp_ns,))
    np.testing.assert_array_equal(
        np.concatenate([before.trajectory.p, after.trajectory.p]), poses.p
    )
    np.testing.assert_array_equal(
        np.concatenate([before.series[0].field, after.series[0].field]), field
    )
    assert (before.series[0].stamp_ns < stamp_ns).all()
    assert (after.scalars[0].stamp_ns >= stamp_ns).all()
    assert len(before.scalars[0]) + len(after.scalars[0]) == 10

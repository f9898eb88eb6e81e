"""The scans of a loop matcher as arrays, and back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.lidar.loop_closures import LoopOptions
from l2m_gtsam.slam.online.packing import packed_loops, resume_loops
from l2m_gtsam.slam.online.scan_matching import KeptScan, LoopMatcher
from l2m_gtsam.slam.options import DriftOptions


def matcher() -> LoopMatcher:
    return LoopMatcher(LoopOptions(), DriftOptions(), 28.0)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_what_is_kept_comes_back(count: int) -> None:
    """Bit for bit, whatever was kept: nothing, or scans of different sizes."""
    rng = np.random.default_rng(count)
    kept = [
        KeptScan(
            7 * number,
            RigidTransform(Rotation.random(random_state=number).as_matrix(), rng.normal(size=3)),
            10**18 + number,
            rng.normal(size=(5 + number, 3)).astype(np.float32),
            1.5 * number,
        )
        for number in range(count)
    ]
    before, after = matcher(), matcher()
    before.resume(kept, 12.5, 11.0)
    resume_loops(after, packed_loops(before))
    assert (after.path_m, after.last_m) == (12.5, 11.0)
    assert len(after.kept) == count
    for one, other in zip(kept, after.kept, strict=True):
        assert (one.key_pose, one.stamp_ns, one.path_m) == (
            other.key_pose, other.stamp_ns, other.path_m,
        )  # fmt: skip
        assert other.points.dtype == np.float32
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_array_equal(one.T_key_scan.R, other.T_key_scan.R)
        np.testing.assert_array_equal(one.T_key_scan.t, other.T_key_scan.t)

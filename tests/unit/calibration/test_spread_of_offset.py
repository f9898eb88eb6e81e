"""An offset H that varies more than the graph says, of which a part may be undetermined."""

from typing import cast

import numpy as np

from l2m_gtsam.calibration.joint import SensorSolution
from l2m_gtsam.records.calibration import ResidualFigures
from l2m_gtsam.solve.rank import Determinacy

SIZE, H = 16, slice(12, 15)


def solution(undetermined: list[int]) -> SensorSolution:
    root = np.random.default_rng(0).normal(size=(SIZE, SIZE))
    covariance = root @ root.T
    covariance[undetermined], covariance[:, undetermined] = 0.0, 0.0
    covariance[undetermined, undetermined] = np.inf
    figures, determinacy = cast("ResidualFigures", None), cast("Determinacy", None)
    return SensorSolution(0, covariance, figures, determinacy, 0.0, shared_root=root[:-1])


def test_what_is_determined_varies_by_as_much_more_and_shares_as_much() -> None:
    before, spread = solution([]), np.diag([1.0, 4.0, 9.0]) + 0.5
    after = before.with_spread_of_H(spread)
    added = after.joint_covariance - before.joint_covariance
    # Rounding of elements of some ten.
    np.testing.assert_allclose(added[H, H], spread, atol=1e-12)
    assert not added[:12].any()
    assert before.shared_root is not None
    assert after.shared_root is not None
    np.testing.assert_allclose(
        np.sum(after.shared_root[H] ** 2, axis=1), np.diag(after.covariance)[H], rtol=1e-12
    )
    np.testing.assert_array_equal(after.shared_root[:12], before.shared_root[:12])


def test_what_is_undetermined_stays_so_without_correlation() -> None:
    """Infinity over infinity was no number, in the rows that other sensors are compared by."""
    before = solution([13])
    after = before.with_spread_of_H(np.eye(3) + 0.5)
    assert np.isinf(after.covariance[13, 13])
    assert not after.covariance[13, [0, 12, 14]].any()
    assert after.covariance[12, 14] == before.covariance[12, 14] + 0.5
    assert after.shared_root is not None
    assert np.isfinite(after.shared_root).all()

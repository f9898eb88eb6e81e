"""A stretch of a drive by iSAM2 whose linear systems GTSAM's Cholesky refuses."""

import gtsam
import numpy as np
import pytest

from l2m_factors import X
from l2m_gtsam.slam.online.section import Section
from tests.drives.pose_chain import FAR_APART, chain, off


@pytest.mark.parametrize(("start", "step"), FAR_APART)
def test_where_cholesky_is_refused_a_section_goes_on_by_qr(
    start: list[float], step: list[float]
) -> None:
    """Poses that come in three groups, the last of them to the next section."""
    graph, values, P = chain(start, step)
    section = Section([])
    for first, last in ((0, 3), (4, 6), (7, 8)):
        if last == 8:
            section = section.next(6)
        part, begin = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for k in range(first, last + 1):
            part.add(graph.at(k))
            begin.insert(X(k), values.atPose3(X(k)).retract(np.full(6, 1e-6)))
        section.add(part, begin, last, 5)
        assert off(section.covariance(last), P[last]) < 1e-4
        assert section.pose(last).equals(values.atPose3(X(last)), 1e-4)

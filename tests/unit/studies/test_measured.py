"""What a piece of work takes."""

import numpy as np
import pytest

from l2m_gtsam.studies.measured import MeasuredWork, measured

MIB = 2**20


def test_memory_counts_at_its_peak_and_each_work_alone() -> None:
    """Sixty MiB for a moment, then ten: to the pages that a process takes beside them."""
    large = measured(lambda: np.ones(60 * MIB // 8).sum())
    small = measured(lambda: np.ones(10 * MIB // 8).sum())
    if large.peak_mib is None or small.peak_mib is None:
        pytest.skip("the system does not report memory")
    assert large.result == 60 * MIB // 8
    assert 55 < large.peak_mib < 75
    assert 5 < small.peak_mib < 25
    assert large.seconds > 0


def test_a_part_of_a_result_took_as_long() -> None:
    whole = measured(lambda: (1, "text"))
    assert whole.of(whole.result[1]) == MeasuredWork("text", whole.seconds, whole.peak_mib)

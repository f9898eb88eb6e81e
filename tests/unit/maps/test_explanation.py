"""What a harmonic map says of the noise of its readings beside that of the sensors' data sheet."""

import pytest

from l2m_gtsam.maps.harmonic.explanation import Explanation


@pytest.mark.parametrize(
    ("noise", "said", "uncalibrated"), [(0.11, 0, False), (0.2, 1, False), (0.35, 1, True)]
)
def test_noise_far_above_the_sensors_names_the_likely_cause(
    noise: float, said: int, uncalibrated: bool
) -> None:
    reasons = Explanation(1.0, 1.0, 0.0, noise, sensor_noise=0.1).reasons
    assert len(reasons) == said
    assert ("l2m map suite" in "".join(reasons)) == uncalibrated


@pytest.mark.parametrize(
    ("spread", "worst", "times"),
    [(1.1, 1.9, 1.0), (1.5, 1.4, 1.5), (1.1, 2.2, 2.2), (float("nan"), float("nan"), 1.0)],
)
def test_errors_count_as_large_as_held_out_readings_show(
    spread: float, worst: float, times: float
) -> None:
    """Of the worst tile where one is; 1 for what chance explains, and where nothing was judged."""
    found = Explanation(spread, worst, 0.0, 0.1, sensor_noise=None)
    assert found.errors_over_stated == times

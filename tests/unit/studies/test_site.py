"""Where the sensors of a site may sit."""

import numpy as np
import pytest
from pydantic import ValidationError

from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import MappingSuiteOptions
from l2m_gtsam.studies.site import SiteOptions, random_place


def at(*heights: float) -> SiteOptions:
    return SiteOptions(scenario=ScenarioOptions(suite=MappingSuiteOptions(heights=heights)))


@pytest.mark.parametrize("heights", [(0.7,), (0.6, 0.9), (-0.6, -0.8)])
def test_heights_beyond_the_radius_are_refused(heights: tuple[float, ...]) -> None:
    with pytest.raises(ValidationError, match=r"none is less than the `radius` of 0\.6 m away"):
        at(*heights)


@pytest.mark.parametrize("heights", [(0.5, 0.9), (-0.8, -0.5), (-2.0, 2.0)])
def test_sensors_sit_at_heights_that_are_within_the_radius(heights: tuple[float, ...]) -> None:
    places = [random_place(at(*heights), np.random.default_rng(seed)) for seed in range(20)]
    assert min(heights) <= min(place[2] for place in places)
    assert max(place[2] for place in places) <= max(heights)
    assert max(np.linalg.norm(place) for place in places) <= 0.6

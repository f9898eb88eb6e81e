"""Surveys with exact poses, clocks and sensors: nothing is found wrong with them.

In these two halls a single place looked like heights of 12 mm that are wrong, and like a clock that
drifts by 180 ms. Sensors that were calibrated in their maps were off by 10 and by 30 mm.
"""

import pytest

from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World
from l2m_gtsam.studies.troubles.surveys import troubled_place


@pytest.mark.parametrize("seed", [775, 797])
def test_nothing_is_wrong_with_an_exact_survey(seed: int) -> None:
    place = troubled_place(TroublesOptions(seed=seed), World.HALL, Trouble.CLEAN, 0)
    assert isinstance(place.field_map, HarmonicMap)
    assert place.field_map.summary.doubts == ()

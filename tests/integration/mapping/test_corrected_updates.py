"""A map that is given more drives says what was corrected of them."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.mapping.map_building import map_recordings, update_map
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from tests.drives.suite_surveys import CLOCK, QUICK, suite, surveyed
from tests.worlds.quick_maps import quick
from tests.worlds.surveyed import strange_hall

EXACT = PoseNoiseOptions(
    position_m=0.0, rotation_deg=0.0
)  # what poses are off by is not looked for


def test_a_jump_in_a_drive_that_is_added_is_a_doubt_on_the_map() -> None:
    sensors, world = suite(2, 2), strange_hall(2)
    known = {each.sensor: replace(each, time_offset=-CLOCK) for each in sensors}
    options = MappingOptions(model=quick("harmonic"), suite=QUICK, pose_noise=EXACT)
    first, second = surveyed(2, sensors, world), surveyed(3, sensors, world)
    few = [replace(e, stamp_ns=e.stamp_ns[::12], field=e.field[::12]) for e in first.series]
    first = replace(first, series=tuple(few))
    field_map = map_recordings([first], known, options)
    assert isinstance(field_map, HarmonicMap)
    series = second.series[0]
    after = np.arange(len(series)) > len(series) / 2
    jumping = replace(series, field=series.field + np.outer(after, [2.0, -1.0, 1.0]))
    second = replace(second, series=(jumping, *second.series[1:]))
    updated = update_map(field_map, [second], known, options)
    assert isinstance(updated, HarmonicMap)
    assert not any("jumped" in each for each in field_map.summary.doubts)
    assert any("H of mag_00 jumped by 2.4 uT" in each for each in updated.summary.doubts)

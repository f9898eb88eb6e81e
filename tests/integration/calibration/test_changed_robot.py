"""A real robot comes to a place where shelves were put since it was mapped.

Passes 1 to 3 make the map by the robot's first magnetometer, which is calibrated from them; pass 4
is calibrated on it. The shelves' field is that of magpylib; all else is as it was recorded.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Distortion, KnownSensor, Recording
from l2m_gtsam.mapping.map_building import MappingOptions, map_recordings
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.mapping.suite_likelihood import SuiteCalibrationOptions
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.places import Cause
from tests.drives.robot import SENSORS, assumed_sensors, robot_pass
from tests.drives.shelves import Shelf, with_shelves

FIRST = SENSORS[0]
UPRIGHT = Shelf((0.4, -1.0, 0.5), (5.0, 3.0, 20.0), (0.04, 0.04, 1.0))
OTHERS = (
    Shelf((4.3, -2.6, 0.4), (-15.0, 10.0, 0.0), (0.04, 1.0, 0.04)),
    Shelf((3.5, 0.3, 0.3), (0.0, 20.0, -20.0), (0.04, 0.04, 1.0)),
)


def map_by(passes: list[Recording]) -> FieldMap:
    """Return the map of passes by their first sensor, which is calibrated from them."""
    alone = [replace(each, series=each.series[:1]) for each in passes]
    assumed = {FIRST: KnownSensor(FIRST, np.zeros(3), Distortion.identity())}
    sensor = calibrate_suite(alone, assumed, SuiteCalibrationOptions(), silent).sensors[0]
    covariance = np.zeros((16, 16))
    covariance[:15, :15] = sensor.covariance
    offset = sensor.time_offset
    assert offset is not None
    covariance[15, 15] = offset.sigma**2
    covariance[:15, 15] = covariance[15, :15] = offset.cross_covariance
    known = KnownSensor(FIRST, sensor.t_lidar_mag, sensor.distortion, offset.seconds, covariance)
    return map_recordings(alone, {FIRST: known}, MappingOptions())


@pytest.fixture(scope="module")
def passes(shared_data: Path) -> dict[int, Recording]:
    return {run: robot_pass(shared_data, run) for run in (1, 2, 3, 4)}


@pytest.fixture(scope="module")
def survey(passes: dict[int, Recording]) -> FieldMap:
    return map_by([passes[run] for run in (1, 2, 3)])


@pytest.fixture(scope="module")
def clean(passes: dict[int, Recording], survey: FieldMap) -> CalibrationResult:
    return calibrate(passes[4], survey, CalibrationOptions())


@pytest.mark.study
@pytest.mark.parametrize("shelves", [(UPRIGHT,), (UPRIGHT, *OTHERS)], ids=["one", "three"])
def test_shelves_are_found_and_do_no_harm(
    shared_data: Path,
    passes: dict[int, Recording],
    survey: FieldMap,
    clean: CalibrationResult,
    shelves: tuple[Shelf, ...],
) -> None:
    places = np.array([each.t_lidar_mag for each in assumed_sensors(shared_data).values()])
    changed = with_shelves(passes[4], shelves, places, clean)
    found = calibrate(changed, survey, CalibrationOptions())
    for shelf in shelves:
        away = [np.linalg.norm(each.position - shelf.position) for each in found.sources]
        source = found.sources[int(np.argmin(away))]
        assert min(away) < 0.3
        # Within 30 %, or two of its sigmas where the pass does not determine it to that: the two at
        # the edge of the map are seen from one side, beside a field of 0.5 to 0.9 uT that the map
        # misses on this pass without shelves, too.
        size = float(np.linalg.norm(shelf.moment))
        sigma = float(np.linalg.norm(source.moment_sigma * shelf.moment)) / size
        off = abs(float(np.linalg.norm(source.moment)) - size)
        assert off < max(0.3 * size, min(2 * sigma, 0.45 * size))
        assert source.cause in (Cause.PLACE, None)
    errors = {
        name: [(each[name].t_lidar_mag - place)[:2] for each in (clean, found)]
        for name, place in zip(SENSORS, places, strict=True)
    }
    squares = [[float(e @ e) for e in pair] for pair in errors.values()]
    before, after = np.sqrt(np.mean(squares, axis=0))
    assert after < 1.3 * before
    for name, pair in errors.items():
        # One sensor is outside of its 95 % without shelves, too (11.8 for 5.99).
        old, new = (
            float(e @ np.linalg.solve(each[name].covariance[:2, :2], e))
            for e, each in zip(pair, (clean, found), strict=True)
        )
        assert new < max(5.99, 1.3 * old)


@pytest.mark.study
@pytest.mark.parametrize("run", [1, 2, 3, 4])
def test_a_place_that_did_not_change_has_no_source(passes: dict[int, Recording], run: int) -> None:
    field_map = map_by([each for other, each in passes.items() if other != run])
    assert calibrate(passes[run], field_map, CalibrationOptions()).sources == ()

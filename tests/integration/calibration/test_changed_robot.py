"""A real robot comes to a place where shelves were put since it was mapped.

Passes 1 to 3 make the map by the robot's first magnetometer, which is calibrated from them; pass 4
is calibrated on it. The shelves' field is that of magpylib; all else is as it was recorded.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.places import Cause, ChangedSource
from l2m_gtsam.studies.slam_array.robot import SENSORS, assumed_sensors, robot_pass
from tests.drives.robot import map_by
from tests.drives.shelves import Shelf, with_shelves

UPRIGHT = Shelf((0.4, -1.0, 0.5), (5.0, 3.0, 20.0), (0.04, 0.04, 1.0))
OTHERS = (
    Shelf((4.3, -2.6, 0.4), (-15.0, 10.0, 0.0), (0.04, 1.0, 0.04)),
    Shelf((3.5, 0.3, 0.3), (0.0, 20.0, -20.0), (0.04, 0.04, 1.0)),
)


@pytest.fixture(scope="module")
def passes(shared_data: Path) -> dict[int, Recording]:
    return {run: robot_pass(shared_data, run) for run in (1, 2, 3, 4)}


@pytest.fixture(scope="module")
def survey(passes: dict[int, Recording]) -> FieldMap:
    return map_by([passes[run] for run in (1, 2, 3)])


@pytest.fixture(scope="module")
def clean(passes: dict[int, Recording], survey: FieldMap) -> CalibrationResult:
    return calibrate(passes[4], survey, CalibrationOptions())


@dataclass(frozen=True)
class Shelved:
    """Pass 4 with the field of shelves in its readings, calibrated."""

    shelves: tuple[Shelf, ...]
    places: FloatArray
    result: CalibrationResult

    def nearest(self, shelf: Shelf) -> ChangedSource:
        """Return the source that is nearest to a shelf."""
        away = [np.linalg.norm(each.position - shelf.position) for each in self.result.sources]
        return self.result.sources[int(np.argmin(away))]

    def errors(self, result: CalibrationResult) -> dict[str, FloatArray]:
        """Return the errors of x and y of all sensors in a calibration, metres."""
        pairs = zip(SENSORS, self.places, strict=True)
        return {name: (result[name].t_lidar_mag - place)[:2] for name, place in pairs}


@pytest.fixture(scope="module", params=[(UPRIGHT,), (UPRIGHT, *OTHERS)], ids=["one", "three"])
def shelved(
    request: pytest.FixtureRequest,
    shared_data: Path,
    passes: dict[int, Recording],
    survey: FieldMap,
    clean: CalibrationResult,
) -> Shelved:
    shelves: tuple[Shelf, ...] = request.param
    places = np.array([each.t_lidar_mag for each in assumed_sensors(shared_data).values()])
    changed = with_shelves(passes[4], shelves, places, clean)
    return Shelved(shelves, places, calibrate(changed, survey, CalibrationOptions()))


@pytest.mark.study
def test_shelves_are_found_and_do_no_harm(shelved: Shelved, clean: CalibrationResult) -> None:
    for shelf in shelved.shelves:
        source = shelved.nearest(shelf)
        assert np.linalg.norm(source.position - shelf.position) < 0.3
        assert source.cause in (Cause.PLACE, None)
    before, after = (
        np.sqrt(np.mean([e @ e for e in shelved.errors(each).values()]))
        for each in (clean, shelved.result)
    )
    assert after < 1.3 * before


@pytest.mark.study
def test_moments_are_known_to_thirty_percent(shelved: Shelved) -> None:
    for shelf in shelved.shelves:
        size = np.linalg.norm(shelf.moment)
        assert abs(np.linalg.norm(shelved.nearest(shelf).moment) / size - 1) < 0.3


@pytest.mark.study
def test_sensors_are_inside_their_ellipses(shelved: Shelved) -> None:
    for name, e in shelved.errors(shelved.result).items():
        covariance = shelved.result[name].covariance[:2, :2]
        assert e @ np.linalg.solve(covariance, e) < 5.99  # 95 %


@pytest.mark.study
@pytest.mark.parametrize("run", [1, 2, 3, 4])
def test_a_place_that_did_not_change_has_no_source(passes: dict[int, Recording], run: int) -> None:
    field_map = map_by([each for other, each in passes.items() if other != run])
    assert calibrate(passes[run], field_map, CalibrationOptions()).sources == ()

"""Steel in a hall whose map errs: its cloud shows no floor. Long: `make study` runs it."""

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.coverage import errors_over_stated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.studies.changes import loads
from l2m_gtsam.studies.changes.loads import ChangesStudyOptions, loaded_hall
from l2m_gtsam.studies.honesty.drives import drive_seed
from l2m_gtsam.studies.validation.drives import NO_STEEL, path_of, recorded

pytestmark = pytest.mark.study

OPTIONS, ERRING, LACKING = ChangesStudyOptions(), 10, 19  # halls of the study of changes


@pytest.fixture(autouse=True)
def no_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have maps made of clouds without floor: loads lower than 0.65 m are no structure to them."""
    monkeypatch.setattr(loads, "floor_cloud", lambda hall: np.empty((0, 3)))


def test_steel_that_the_map_lacks_is_a_doubt_of_it_and_no_change() -> None:
    """A load of 2.5 A m2 that stood there; its field at the readings is up to 2.6 uT."""
    place = loaded_hall(OPTIONS, LACKING)
    path = path_of(OPTIONS, place.hall, drive_seed(place.seed, 5))
    drive = recorded(OPTIONS, place.hall, path, place.sensors, NO_STEEL)
    result = calibrate(drive, place.field_map, CalibrationOptions())
    assert not result.sources
    assert any("lacks steel at (1." in each for each in result.doubts)


def test_steel_that_moved_is_found_and_does_little_harm() -> None:
    """Without changes t is 4 to 9 mm off there; 75 to 90 mm where steel is not looked for."""
    place = loaded_hall(OPTIONS, ERRING)
    assert errors_over_stated(place.field_map) > 1.2
    path, changes = path_of(OPTIONS, place.hall, drive_seed(place.seed, 0)), place.changes[0]
    drive = recorded(OPTIONS, place.hall, path, place.sensors, changes.steel(OPTIONS))
    result = calibrate(drive, place.field_map, CalibrationOptions())
    strong = [k for k, moment in enumerate(changes.moments) if np.linalg.norm(moment) > 10]
    for k in strong:
        away = [np.linalg.norm(each.position - changes.positions[k]) for each in result.sources]
        assert min(away) < 0.3
    for truth in place.sensors:
        found = result[truth.sensor]
        # That the search for starts knew nothing of the steel leaves no doubt in the end.
        assert found.status is SensorStatus.SOLVED
        assert np.linalg.norm(found.t_lidar_mag - truth.t_lidar_mag) < 0.02

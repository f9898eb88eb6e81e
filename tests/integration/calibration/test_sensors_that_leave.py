"""Sensors that nothing holds in the map: undetermined, or the map is of another place."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import Calibrated, calibrate, calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import FieldSample, FloatArray, Recording, Trajectory
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.qa.evaluate import measured
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.qa.verdict.sensor import WRONG_MAP
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.records.error_budget import OffsetJump
from l2m_gtsam.records.verdict import Level, Verdict
from tests.drives.degenerate import PLACES, STRONG, eight, recorded
from tests.drives.verdict import EIGHT, drive
from tests.worlds.exact import DipoleWorld, dipole_world

NO_HALVES = QaOptions(halves=False)


@dataclass(frozen=True)
class Hall(DipoleWorld):
    """A world that is known near the floor of a hall only."""

    def query(self, points: FloatArray) -> FieldSample:
        sample = super().query(points)
        inside = (np.abs(points[:, :2]) < 6.0).all(axis=1) & (np.abs(points[:, 2]) < 1.0)
        return replace(sample, inside=inside)


def hall(world: DipoleWorld) -> Hall:
    return Hall(world.uniform, world.positions, world.moments)


def verdict_on(recording: Recording, found: Calibrated, options: CalibrationOptions) -> Verdict:
    return judge(found.result, measured(recording, found, options, NO_HALVES), NO_HALVES)


@pytest.mark.parametrize("trajectory", [eight(), eight(0, 0)], ids=["swaying", "level"])
@pytest.mark.parametrize("share", [0.0, 0.003])
def test_a_calm_field_leaves_places_open(trajectory: Trajectory, share: float) -> None:
    world = DipoleWorld(STRONG.uniform, STRONG.positions, share * STRONG.moments)
    recording, options = recorded(trajectory, world, PLACES), CalibrationOptions()
    found = calibrated(recording, hall(world), options)
    (sensor,) = found.result.sensors
    assert sensor.status in (SensorStatus.UNDETERMINED, SensorStatus.NOT_CONVERGED)
    assert np.isinf(sensor.t_sigma).all()
    assert "position" in sensor.message
    verdict = verdict_on(recording, found, options)
    assert verdict.level is Level.FAIL
    assert verdict["mag_0"].reasons[0].text.startswith("Not everything can be known")
    texts = [each.text for each in (*verdict.reasons, *verdict["mag_0"].reasons)]
    assert not any("does not cover" in each or "does not fit" in each for each in texts)


def test_a_map_of_another_place_is_named_in_a_report() -> None:
    whole = drive()
    elsewhere, options = hall(dipole_world(5)), CalibrationOptions()
    found = calibrated(whole.recording, elsewhere, options)
    verdict = verdict_on(whole.recording, found, options)
    assert verdict.level is Level.FAIL
    assert verdict.reasons[0].text == WRONG_MAP
    for sensor in found.result.sensors:
        first = verdict[sensor.sensor].reasons[0].text
        assert "the map does not fit this drive" in first


@pytest.mark.parametrize(("change_ut", "is_told"), [(400.0, True), (2.0, False)])
def test_a_jump_that_no_map_makes_up_is_told_beside_a_map_that_does_not_fit(
    change_ut: float, is_told: bool
) -> None:
    """A magnet beside the sensor, in a map that may be of elsewhere: both are told."""
    whole = drive()
    found = calibrated(whole.recording, hall(dipole_world(5)), CalibrationOptions())
    jump = OffsetJump("mag_0", 53_600_000_000, 12.0, (0.0, change_ut, 0.0), (0.1, 0.1, 0.1))
    jumped = replace(found, result=replace(found.result, jumps=(jump,)))
    first, *others = verdict_on(whole.recording, jumped, CalibrationOptions())["mag_0"].reasons
    assert "the map does not fit this drive" in first.text
    told = "At stamp 53.60 s, 12 s after the first reading that counts, its offset H jumped by 400"
    assert any(each.text.startswith(told) for each in others) is is_told


def test_a_short_drive_is_named_with_its_remedy_alone() -> None:
    whole = drive(EIGHT[np.arange(20)])
    with pytest.raises(CalibrationError) as error:
        calibrate(whole.recording, whole.field_map, whole.options)
    told = str(error.value)
    assert told.startswith("drive.bag: no sensor can be solved: mag_0: ")
    assert told.endswith("at least 30 are needed: drive on, or record its readings more often")
    assert "another place" not in told

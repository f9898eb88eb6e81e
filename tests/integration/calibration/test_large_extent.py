"""A drive that crosses more of a map than a calibration, or a test of one, takes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.data import Recording, SourceFile
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.planning.motion import PlanOptions
from l2m_gtsam.planning.plan import plan
from l2m_gtsam.recording.splitting import split_at
from l2m_gtsam.records.calibration import CalibrationResult, SensorStatus
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.validation import drive_test
from l2m_gtsam.validation.validate import validate
from tests.drives.moving import MovingDrive, moving_drive, options
from tests.drives.uncertain import NOISE, surveyed

LIMIT = 50  # numbers of the map's errors; the drive has twice as many


@pytest.fixture(scope="module")
def made() -> MovingDrive:
    return moving_drive(3, (0.0, 0.0))


def halves_of(drive: Recording) -> tuple[Recording, Recording]:
    """Return both halves of a drive, each of a file of its own."""
    stamps = drive.trajectory.stamp_ns
    one, other = split_at(drive, int(stamps[len(stamps) // 2]))
    return (
        replace(one, source=SourceFile("one.bag", "1")),
        replace(other, source=SourceFile("other.bag", "2")),
    )


def solved(made: MovingDrive, most: int) -> CalibrationResult:
    chosen = options(made)
    solve = chosen.solve.model_copy(update={"most_weights": most})
    chosen = chosen.model_copy(update={"solve": solve})
    return calibrate(made.silent, surveyed(1), chosen)


def test_a_part_of_the_drive_counts(made: MovingDrive, tmp_path: Path) -> None:
    """It is less sure than the whole, and right: five sigmas of thirty values."""
    whole, part = solved(made, 6000), solved(made, LIMIT)
    assert not any("tiles of the map" in each for each in whole.notes)
    (said,) = [each for each in part.notes if "tiles of the map" in each]
    assert "calibration.solve.most_weights" in said
    for k, (known, one, all_) in enumerate(
        zip(made.sensors, part.sensors, whole.sensors, strict=True)
    ):
        assert one.status is SensorStatus.SOLVED
        assert one.sensor == known.sensor
        assert one.sync.elsewhere > 0
        assert one.sync.kept == one.used + one.rejected + one.outside_map
        assert one.sync.kept + one.sync.elsewhere == all_.sync.kept
        away = made.error(k, one.vector()) / np.sqrt(np.diag(one.covariance))
        assert np.abs(away).max() < 5
        assert (one.t_sigma > all_.t_sigma).all()
    write_calibration(tmp_path / "a.yaml", part)
    back = read_calibration(tmp_path / "a.yaml")
    assert [each.sync for each in back.sensors] == [each.sync for each in part.sensors]


def test_too_small_a_part_is_named(made: MovingDrive) -> None:
    """Most readings are in tiles that do not count: nothing is wrong with the sensor."""
    chosen = options(made)
    few = {"most_weights": LIMIT, "min_readings": 490}
    chosen = chosen.model_copy(update={"solve": chosen.solve.model_copy(update=few)})
    with pytest.raises(CalibrationError) as said:
        calibrate(made.silent, surveyed(1), chosen)
    assert " 177 in parts of the map that do not count), at least 490 are needed" in str(said.value)
    assert str(said.value).endswith(": raise `calibration.solve.most_weights`")


def test_a_calibration_is_tested_on_a_part(
    made: MovingDrive, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first half of a drive is the calibration's; the second has as much of the map."""
    first, second = halves_of(made.silent)
    calibration = calibrate(first, surveyed(1), options(made))
    monkeypatch.setattr(drive_test, "MOST_WEIGHTS", LIMIT)
    found = validate(second, surveyed(1), calibration, options(made), 1e-3)
    assert [each.sensor for each in found.sensors] == ["mag_00", "mag_01"]
    assert any("tiles of the map" in each for each in found.notes)
    for each in found.sensors:
        assert not each.changes


def test_a_plan_foretells_the_part_that_will_count(made: MovingDrive) -> None:
    """With C = I: distortions of a tenth, and readings that are rejected, change sigmas by less."""
    chosen = options(made)
    solve = chosen.solve.model_copy(update={"most_weights": LIMIT, "sensor_noise_ut": NOISE})
    chosen = chosen.model_copy(update={"solve": solve})
    found = plan(made.silent, surveyed(1), chosen, PlanOptions())
    assert any("tiles of the map" in each for each in found.notes)
    result = calibrate(made.silent, surveyed(1), chosen)
    for each in found.sensors:
        one = result[each.sensor]
        assert each.readings == one.used + one.rejected
        np.testing.assert_allclose(each.sigma[:3], one.t_sigma, rtol=0.3)

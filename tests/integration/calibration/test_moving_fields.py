"""A motor's field beside the map's: with its current recorded it does no harm and is found."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.cli.tables.calibration import model_note, model_tables
from l2m_gtsam.data import ScalarSeries
from l2m_gtsam.errors import SyncError
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.records.sensor_models import Model
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from tests.drives.moving import STEP_NS, MovingDrive, moving_drive, options
from tests.drives.uncertain import WORLD, surveyed
from tests.support.records import assert_equal

SEED = 1
MORE_SEEDS = range(1, 5)
STRONG = 0.6  # uT/A, of a current that swings by 2 A: twenty times the noise


@dataclass(frozen=True)
class Calibrated:
    """A drive and its calibrations without and with the motor's current, made when asked for."""

    seed: int
    drive: MovingDrive
    steel: bool

    @cached_property
    def silent(self) -> CalibrationResult:
        chosen = options(self.drive, steel=self.steel)
        return calibrate(self.drive.silent, surveyed(self.seed), chosen)

    @cached_property
    def told(self) -> CalibrationResult:
        chosen = options(self.drive, steel=self.steel)
        return calibrate(self.drive.recording, surveyed(self.seed), chosen)


@cache
def calibrated(seed: int, strengths: tuple[float, ...], steel: bool = False) -> Calibrated:
    return Calibrated(seed, moving_drive(seed, strengths), steel)


def nees(drive: MovingDrive, result: CalibrationResult) -> list[float]:
    """Return the squared error in sigmas of (t, C, H) of each sensor; 15 are expected."""
    errors = [drive.error(i, each.vector()) for i, each in enumerate(result.sensors)]
    return [
        float(e @ np.linalg.solve(each.covariance, e))
        for e, each in zip(errors, result.sensors, strict=True)
    ]


@pytest.mark.parametrize(
    ("seed", "steel"), [(SEED, False), pytest.param(2, True, marks=pytest.mark.study)]
)
def test_without_the_current_something_is_wrong_with_it_it_is_not(seed: int, steel: bool) -> None:
    found = calibrated(seed, (STRONG, STRONG), steel)
    # A current that nobody recorded is noticed: an offset that wanders, or parts that disagree.
    # Sigmas do not hold all of it: NEES was 336 where 15 are expected, over 1,000 without that.
    wandering = {each.sensor for each in found.silent.disturbances}
    for sensor in found.silent.sensors:
        assert sensor.sensor in wandering or sensor.unmodelled.largest > 1
    assert min(nees(found.drive, found.silent)) > max(nees(found.drive, found.told))
    assert found.told.disturbances == ()
    for known, sensor in zip(found.drive.sensors, found.told.sensors, strict=True):
        assert sensor.status is SensorStatus.SOLVED
        assert sensor.models is not None
        assert sensor.models.recommended is Model.REGRESSORS
        assert [each.name for each in sensor.moving] == ["motor"]
        assert sensor.rejected <= 2  # of 500; one in 10,000 is expected
        # Two sensors share a map's error; sigmas are 4 to 7 mm per axis.
        assert np.linalg.norm(sensor.t_lidar_mag - known.t_lidar_mag) < 0.03


def squares(seeds: Iterable[int]) -> tuple[float, float]:
    """Return the mean square of errors in sigmas over drives: of (t, C, H), and of h."""
    found = [calibrated(seed, (STRONG, STRONG)) for seed in seeds]
    mean = np.mean([nees(each.drive, each.told) for each in found]) / 15
    ratios = [
        (sensor.moving[0].h - h) / sensor.moving[0].sigma
        for each in found
        for sensor, h in zip(each.told.sensors, each.drive.h, strict=True)
    ]
    return float(mean), float(np.mean(np.square(ratios)))


@pytest.mark.parametrize("drives", [1, pytest.param(2, marks=pytest.mark.study)])
def test_sigmas_are_true(drives: int) -> None:
    """t, C, H and h of two sensors a drive.

    Sensors of a drive share the map's errors: sums have the spread of one of them at the least. So
    bands are those of chi squared with 15 degrees of freedom a drive and with 3, left once in
    10,000.
    """
    of_sensors, of_motor = squares(range(SEED, SEED + drives))
    for found, freedom in ((of_sensors, 15 * drives), (of_motor, 3 * drives)):
        assert chi2.ppf(5e-5, freedom) / freedom < found < chi2.ppf(1 - 5e-5, freedom) / freedom


@pytest.mark.study
def test_sigmas_are_true_over_drives_and_maps() -> None:
    """t, C, H and h of eight sensors over four maps.

    Sensors of a drive share the map's errors: sums have the spread of four drives at the least.
    """
    of_sensors, of_motor = squares(MORE_SEEDS)
    # 60 degrees of freedom: 4 sigmas of sqrt(2 / 60) either way.
    assert 0.4 < of_sensors < 1.75
    # 24 numbers, of which 12 may be independent: 4 sigmas of sqrt(2 / 12).
    assert 0.2 < of_motor < 2.7


def test_a_current_that_nothing_follows_changes_nothing() -> None:
    found = calibrated(2, (0.0, 0.0))
    for silent, told in zip(found.silent.sensors, found.told.sensors, strict=True):
        assert told.models is not None
        assert not told.models.recommended.has_regressors
        assert told.moving == ()
        assert (np.abs(told.t_lidar_mag - silent.t_lidar_mag) < 0.1 * silent.t_sigma).all()


def test_one_sensor_beside_the_motor_and_one_away_from_it() -> None:
    found = calibrated(2, (STRONG, 0.0))
    beside, away = found.told.sensors
    assert [len(beside.moving), len(away.moving)] == [1, 0]
    assert max(nees(found.drive, found.told)) < 44  # 15 degrees of freedom: one in ten thousand


def test_readings_that_were_rejected_count_again() -> None:
    """20 A for a second of every six: without the current they are outliers, a sixth of all."""
    on = np.arange(500) * STEP_NS * 1e-9 % 6 < 1.0
    drive = moving_drive(1, (1.0,), np.where(on, 20.0, 0.0))
    silent, told = (
        calibrate(recording, surveyed(1), options(drive)).sensors[0]
        for recording in (drive.silent, drive.recording)
    )
    # Poses are needed for a quarter of a second, five readings, on either side.
    assert silent.rejected >= on[5:-5].sum()
    assert told.rejected <= 2
    (motor,) = told.moving
    assert np.abs((motor.h - drive.h[0]) / motor.sigma).max() < 4


def test_a_map_without_known_errors_and_a_motor() -> None:
    """The exact field: sigmas count h, which is found beside t, C and H."""
    drive = moving_drive(1, (STRONG,))
    silent, told = (
        calibrate(each, WORLD, options(drive, Uncertainty.INDEPENDENT))
        for each in (drive.silent, drive.recording)
    )
    assert told.uncertainty is Uncertainty.INDEPENDENT
    # It was over 1,000 before parts that disagree widened sums of t, C and H, too.
    assert nees(drive, silent)[0] > 500
    assert nees(drive, told)[0] < 44  # 15 degrees of freedom: one in ten thousand
    (motor,) = told.sensors[0].moving
    assert np.abs((motor.h - drive.h[0]) / motor.sigma).max() < 4


def test_file_table_and_note(tmp_path: Path) -> None:
    told = calibrated(2, (STRONG, 0.0)).told
    write_calibration(tmp_path / "c.yaml", told)
    assert_equal(read_calibration(tmp_path / "c.yaml"), told)
    assert len(model_tables(told)) == 2
    beside, away = (model_note(each) for each in told.sensors)
    assert beside.startswith("model of mag_00: full + regressors (full + regressors predicts")
    assert "; motor: " in beside
    assert "motor: " not in away


def test_readings_without_a_known_number_are_dropped_and_counted() -> None:
    drive = moving_drive(1, (0.0,))
    (motor,) = drive.recording.scalars
    late = replace(motor, stamp_ns=motor.stamp_ns[100:], value=motor.value[100:])
    recording = replace(drive.recording, scalars=(late,))
    sensor = calibrate(recording, surveyed(1), options(drive)).sensors[0]
    without = calibrate(drive.silent, surveyed(1), options(drive)).sensors[0]
    assert sensor.sync.kept + sensor.sync.without_regressor == without.sync.kept
    # Poses are needed for a quarter of a second on either side, thinning takes some more.
    assert 80 <= sensor.sync.without_regressor <= 100


def faulty(name: str, motor: ScalarSeries) -> ScalarSeries:
    if name == "constant":
        return replace(motor, value=np.full(len(motor), 3.2))
    return replace(motor, stamp_ns=motor.stamp_ns - 10**12)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("constant", r"^regressor 'motor': it is 3.2 at all readings, .*leave it out of"),
        ("another time", r"no reading has all recorded numbers: .*'motor' from 16\d+.*max_gap_s"),
    ],
)
def test_senseless_numbers_are_one_line(name: str, expected: str) -> None:
    drive = moving_drive(1, (0.0,))
    recording = replace(drive.recording, scalars=(faulty(name, drive.recording.scalars[0]),))
    with pytest.raises(SyncError, match=expected) as error:
        calibrate(recording, WORLD, options(drive))
    assert "\n" not in str(error.value)


def test_a_sensor_with_few_readings_says_why_there_is_no_comparison() -> None:
    """31 readings, ten less than recorded, solve it."""
    drive = moving_drive(1, (0.0,), count=41)
    sensor = calibrate(drive.recording, WORLD, options(drive)).sensors[0]
    assert sensor.models is None
    assert sensor.not_compared == (
        "models: 31 readings cannot distinguish models of 7 columns in 8 segments, at least 32 are "
        "needed"
    )

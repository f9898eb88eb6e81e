"""Calibrations on other drives: each gets the verdict and the reason that a specialist would."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Distortion, FieldSample, FloatArray, Recording, ScalarSeries, SourceFile
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.qa.fleet import rotations_apart
from l2m_gtsam.qa.metrics.changes import compare_calibrations
from l2m_gtsam.qa.options import Limit, QaOptions, ValidationOptions
from l2m_gtsam.qa.verdict.validation import judge_validation, validation_thresholds
from l2m_gtsam.recording.drive_trace import trace_of
from l2m_gtsam.records.calibration import CalibrationResult, SensorStatus, TimeOffset
from l2m_gtsam.records.places import ChangedSource, WhatChanged
from l2m_gtsam.records.provenance import NamedSource
from l2m_gtsam.records.sensor_models import MovingField
from l2m_gtsam.records.validation import CalibrationPart, DriveValidation, Validation
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.storage.record_files import write_validation
from l2m_gtsam.studies.validation.drives import (
    TrueCause,
    ValidationStudyOptions,
    calibrated_hall,
    changed_drive,
)
from l2m_gtsam.validation.drive_test import joint_covariance
from l2m_gtsam.validation.validate import validate
from tests.drives.calibrations import unsolved
from tests.drives.degenerate import STRONG
from tests.drives.validation import MAP, OPTIONS, calibrated, changed, loops, other_drive
from tests.drives.verdict import NOISE, NOMINAL, SENSORS, drive
from tests.support.records import validation_in
from tests.worlds.exact import DipoleWorld, dipole_world

# These drives show changes of a place from 42 mm on.
QA = QaOptions(validation=ValidationOptions(place_m=Limit(warn=0.01, fail=0.05)))
TURN = Rotation.from_rotvec([0.0, 0.03, 0.05]).as_matrix()


class WestOnly(DipoleWorld):
    """A map that ends at a border."""

    border = 0.0

    def query(self, points: FloatArray) -> FieldSample:
        """Return the exact field west of the border."""
        sample = super().query(points)
        return replace(sample, inside=points[:, 0] < self.border)


def on_drive(
    recording: Recording, calibration: CalibrationResult | None = None, place: DipoleWorld = STRONG
) -> DriveValidation:
    return validate(recording, place, calibration or calibrated(), OPTIONS, 1e-3, MAP)


def judged(found: DriveValidation, options: QaOptions = QA) -> Verdict:
    return judge_validation(found, None, options)


def level_of(verdict: Verdict, sensor: str) -> str:
    return next(each.level for each in verdict.sensors if each.sensor == sensor)


def text_of(verdict: Verdict, sensor: str) -> str:
    (found,) = [each for each in verdict.sensors if each.sensor == sensor]
    return " ".join(each.text for each in found.reasons)


@cache
def good() -> DriveValidation:
    return on_drive(other_drive())


def test_a_good_calibration_passes() -> None:
    """And its field error is the noise: three axes of 0.1 uT, corrected by C of about one."""
    found = good()
    verdict = judged(found)
    assert verdict.level == "pass"
    for sensor in found.sensors:
        assert sensor.changes == ()
        assert sensor.after.squared == pytest.approx(3 * NOISE**2, rel=0.2)
        assert sensor.before.squared > 100 * sensor.after.squared
        # five standard deviations of figures about a noise that was estimated: 0.07 and 5.7
        assert sensor.nis.ratio == pytest.approx(1, abs=0.35)
        assert sensor.parameters.value < 16 + 5 * 5.7


def test_field_errors_are_the_paper_s() -> None:
    """B_AC less B_MR, computed here from poses, field and calibration."""
    recording, calibration = other_drive(), calibrated()
    for index, found in enumerate(good().sensors):
        sensor, series = calibration[found.sensor], recording.series[index]
        # poses half a largest time offset from the ends of the drive take no part
        poses, keep = recording.trajectory, slice(5, -5)
        assert sensor.time_offset is not None
        x = poses.R @ sensor.t_lidar_mag + poses.p
        B = np.einsum("nji,nj->ni", poses.R, STRONG.field_and_gradient(x)[0])
        difference = sensor.distortion.undo(series.field) - B
        error = float(np.mean(np.sum(difference[keep] ** 2, axis=1)))
        # the time offset of a millisecond that the calibration took from noise is not in it here
        assert found.after.squared == pytest.approx(error, rel=0.15)
        assert found.before.squared == pytest.approx(
            float(np.mean(np.sum((series.field - B)[keep] ** 2, axis=1))), rel=0.01
        )


@pytest.mark.parametrize(
    ("part", "change", "word", "size"),
    [
        (CalibrationPart.OFFSET, {"H": np.array([3.0, 0, 0])}, "offset H", 3.0),
        (CalibrationPart.PLACE, {"t": np.array([0.0, 0.03, 0])}, "place t", 0.03),
        (CalibrationPart.ROTATION, {"C": TURN}, "rotation", np.rad2deg(np.hypot(0.03, 0.05))),
        (CalibrationPart.GAINS, {"C": np.diag([1.0, 1.05, 1.0])}, "gains", 0.05),
    ],
)
def test_what_has_changed_is_named(
    part: CalibrationPart, change: dict[str, FloatArray], word: str, size: float
) -> None:
    found = on_drive(other_drive(changed(1, **change)))
    verdict, first = judged(found), found.sensors[1].changes[0]
    assert first.part is part
    # of the sensor's C, which is up to 5 % off one, and with five sigmas of noise
    assert first.size == pytest.approx(size, rel=0.06, abs=5 * max(first.sigma))
    assert verdict.level == level_of(verdict, "mag_1") in ("warn", "fail")
    assert word in text_of(verdict, "mag_1")
    assert level_of(verdict, "mag_0") == level_of(verdict, "mag_2") == "pass"


def test_a_loose_sensor_has_moved_and_turned() -> None:
    found = on_drive(other_drive(changed(2, t=np.array([0.06, 0, 0]), C=TURN)))
    assert {each.part for each in found.sensors[2].changes} >= {
        CalibrationPart.PLACE,
        CalibrationPart.ROTATION,
    }
    assert level_of(judged(found), "mag_2") == "fail"


def test_a_turn_has_the_sign_of_the_sensor_s() -> None:
    """Axes of a sensor turned by 10 degrees about its z: so says the drive, a comparison, a fleet.

    What a sensor reads is the field along its axes, the columns of R_lidar_mag.
    """
    R_lidar_mag = Rotation.from_euler("xyz", [20, -30, 75], degrees=True).as_matrix()
    turned = R_lidar_mag @ Rotation.from_euler("z", 10, degrees=True).as_matrix()
    before, after = (
        replace(SENSORS[0], distortion=Distortion(axes.T, SENSORS[0].distortion.H))
        for axes in (R_lidar_mag, turned)
    )
    options = OPTIONS.model_copy(update={"start": {"mag_0": NOMINAL["mag_0"]}})
    old = calibrate(drive(sensors=(before,)).recording, STRONG, options)
    recording = other_drive((after,))
    (sensor,) = validate(recording, STRONG, old, options, 1e-3).sensors
    first = sensor.changes[0]
    assert first.part is CalibrationPart.ROTATION
    # to first order of a change: ten degrees are 10 sin(10 deg) / 10 deg; and five sigmas
    np.testing.assert_allclose(first.change, [0, 0, 10], atol=0.06 + 5 * max(first.sigma))

    new = calibrate(recording, STRONG, options)
    (compared,) = compare_calibrations(new, old, 1e-3).sensors
    (turn,) = [each for each in compared.changes if each.part is CalibrationPart.ROTATION]
    np.testing.assert_allclose(turn.change, [0, 0, 10], atol=5 * max(turn.sigma))
    rotations = Rotation.from_matrix([each["mag_0"].R_lidar_mag for each in (old, new)])
    then, now = rotations_apart(rotations.as_quat())
    # changes are kept in six digits
    np.testing.assert_allclose(now - then, turn.change, atol=1e-5)


def late_drive() -> Recording:
    """Return a drive on which the clock of one sensor is late by 40 ms."""
    recording = other_drive()
    late = replace(recording.series[0], stamp_ns=recording.series[0].stamp_ns - 40_000_000)
    return replace(recording, series=(late, *recording.series[1:]))


def test_a_clock_that_is_late_is_named() -> None:
    found = on_drive(late_drive())
    (change,) = found.sensors[0].changes
    assert change.part is CalibrationPart.CLOCK
    assert change.change[0] == pytest.approx(0.04, abs=0.003)
    assert level_of(judged(found), "mag_0") == "warn"


@pytest.mark.parametrize(
    "offset", [None, TimeOffset(0.0, np.inf, np.zeros(15), "held at 0: nothing shows it")]
)
def test_a_clock_that_was_not_known_is_not_called_changed(offset: TimeOffset | None) -> None:
    """Whatever it is now; and all other figures are true beside it."""
    known = calibrated()
    unknown = replace(known.sensors[0], time_offset=offset)
    found = on_drive(late_drive(), replace(known, sensors=(unknown, *known.sensors[1:])))
    sensor = found.sensors[0]
    assert np.isinf(joint_covariance(unknown)[15, 15])
    assert sensor.changes == ()
    assert level_of(judged(found), "mag_0") == "pass"
    assert sensor.parameters.freedom == 15
    # five standard deviations of figures about a noise that was estimated: 0.07 and 5.5
    assert sensor.nis.ratio == pytest.approx(1, abs=0.35)
    assert sensor.parameters.value < 15 + 5 * 5.5


def test_clocks_that_are_taken_for_one_take_no_degree_of_freedom() -> None:
    """Where no motion is known, readings do not depend on a clock: fifteen parameters are left."""
    known = calibrated()
    held = TimeOffset(0.0, np.inf, np.zeros(15), "held at 0: nothing shows it")
    sensors = tuple(replace(each, time_offset=held) for each in known.sensors)
    solve = OPTIONS.solve.model_copy(update={"largest_offset_s": 0.0})
    options = OPTIONS.model_copy(update={"solve": solve})
    found = validate(other_drive(), STRONG, replace(known, sensors=sensors), options, 1e-3)
    for each in found.sensors:
        assert each.parameters.freedom == 15
        assert each.nis.freedom == 3 * each.readings


def test_a_map_of_elsewhere_is_told() -> None:
    verdict = judged(on_drive(other_drive(place=dipole_world(77, 15))))
    assert verdict.level == "fail"
    assert "map does not fit this drive" in verdict.reasons[0].text
    assert "offset" not in " ".join(verdict.lines(Level.PASS))


def test_no_steel_is_made_up_where_the_map_is_of_elsewhere() -> None:
    """Sources that bring the map of one hall near the field of another are no steel."""
    options = ValidationStudyOptions(survey_readings=600, readings=120, sensors=1)
    place = calibrated_hall(options, 0)
    drive = changed_drive(options, place, TrueCause.ELSEWHERE, 1).recording
    found = validate(drive, place.field_map, place.calibration, CalibrationOptions(), 1e-3)
    assert found.sources == ()
    assert found.jumps == ()
    assert found.displacement is None
    assert "map does not fit this drive" in judged(found).reasons[0].text


def test_a_changed_place_does_not_pull() -> None:
    """Steel beside the way spoils a tenth of the readings: named, and no change of the sensors."""
    beside = loops().p[150] + [0.5, 0.3, -0.3]
    place = STRONG.with_dipoles(beside, np.array([15.0, 10.0, 20.0]))
    found = on_drive(other_drive(place=place))
    verdict = judged(found)
    for sensor in found.sensors:
        assert 10 < sensor.rejected < 100
        sizes = [each.size for each in sensor.changes if each.part is CalibrationPart.OFFSET]
        assert max(sizes, default=0.0) < 0.5
        assert "the place has changed there" in text_of(verdict, sensor.sensor)


def test_readings_outside_the_map_are_counted() -> None:
    west = WestOnly(STRONG.uniform, STRONG.positions, STRONG.moments)
    found = on_drive(other_drive(), place=west)
    verdict = judged(found)
    for sensor in found.sensors:
        assert sensor.outside > 90
        assert sensor.changes == ()
        assert "lie outside the map" in text_of(verdict, sensor.sensor)
    far = WestOnly(STRONG.uniform, STRONG.positions, STRONG.moments)
    object.__setattr__(far, "border", -100.0)
    nowhere = on_drive(other_drive(), place=far)
    assert nowhere.sensors == ()
    verdict = judged(nowhere)
    assert verdict.level == "fail"
    assert "Is it the map of this place" in text_of(verdict, "mag_0")


def test_sensors_of_one_side_only_are_told() -> None:
    recording, calibration = other_drive(), calibrated()
    new = replace(recording.series[0], sensor="mag_9")
    recording = replace(recording, series=(new, *recording.series[1:]))
    broken = unsolved("mag_2", SensorStatus.NO_READINGS, "it is stuck")
    calibration = replace(calibration, sensors=(*calibration.sensors[:2], broken))
    verdict = judged(on_drive(recording, calibration))
    assert level_of(verdict, "mag_9") == "warn"
    assert "not in the calibration" in text_of(verdict, "mag_9")
    assert level_of(verdict, "mag_0") == "warn"
    assert "not on the drive" in text_of(verdict, "mag_0")
    assert level_of(verdict, "mag_2") == "fail"
    assert "it is stuck" in text_of(verdict, "mag_2")
    assert level_of(verdict, "mag_1") == "pass"
    only_new = replace(recording, series=(new,))
    with pytest.raises(CalibrationError, match="none of its sensors"):
        on_drive(only_new, calibration)


def test_a_stuck_sensor_is_told() -> None:
    recording = other_drive()
    stuck = replace(recording.series[1], field=np.tile([1.0, 2.0, 3.0], (300, 1)))
    series = (recording.series[0], stuck, recording.series[2])
    verdict = judged(on_drive(replace(recording, series=series)))
    assert level_of(verdict, "mag_1") == "fail"
    assert "it is stuck" in text_of(verdict, "mag_1")


def test_its_own_drive_is_refused_and_its_own_map_is_named() -> None:
    calibration = replace(calibrated(), map=MAP)
    notes = judged(on_drive(other_drive(), calibration)).reasons
    assert any("map that it was calibrated with" in each.text for each in notes)
    own = replace(calibration, bag=SourceFile("other.bag", "ef56"))
    with pytest.raises(CalibrationError, match="drive that the calibration was computed from"):
        on_drive(other_drive(), own)
    copied = replace(calibration, bag=None, traces=(trace_of(other_drive().trajectory),))
    with pytest.raises(CalibrationError, match="drive that the calibration was computed from"):
        on_drive(other_drive(), copied)


def test_a_motor_s_field_is_taken_off() -> None:
    """Readings that follow a current, with its field in the calibration: as good as without."""
    recording = other_drive()
    seconds = 1e-9 * (recording.trajectory.stamp_ns - recording.trajectory.stamp_ns[0])
    current, h = 3 * np.sin(2 * seconds), np.array([0.8, -0.5, 0.3])
    series = recording.series[0]
    first = replace(series, field=series.field + current[:, None] * h)
    scalar = ScalarSeries("motor", "/current", recording.trajectory.stamp_ns, current)
    driven = replace(recording, series=(first, *recording.series[1:]), scalars=(scalar,))
    moving = (MovingField("motor", h, np.full(3, 0.01)),)
    plain = calibrated()
    sensor = replace(plain.sensors[0], moving=moving)
    calibration = replace(plain, sensors=(sensor, *plain.sensors[1:]))
    found = on_drive(driven, calibration).sensors[0]
    assert found.changes == ()
    assert found.after.squared == pytest.approx(good().sensors[0].after.squared, rel=0.02)
    assert on_drive(driven).sensors[0].nis.ratio > 4
    with pytest.raises(ConfigError, match=r"follows 'motor', which `bag\.regressors`"):
        on_drive(recording, calibration)


def test_a_change_that_fails_and_would_not_show_is_a_warning() -> None:
    """A PASS says that none happened: what the drive shows has to be less than what fails."""
    verdict = judged(good(), QaOptions())
    for sensor, known in zip(verdict.sensors, good().sensors, strict=True):
        (place,) = [each for each in known.detectable if each.part is CalibrationPart.PLACE]
        limit = QaOptions().validation.place_m.fail
        assert sensor.level == ("warn" if place.size > limit else "pass")
    assert level_of(verdict, "mag_1") == "warn"
    assert "its place t (it shows changes from 42 mm on)" in text_of(verdict, "mag_1")


def test_a_vehicle_at_rest_tests_too_little() -> None:
    recording = other_drive()
    poses = recording.trajectory
    still = replace(poses, R=np.tile(poses.R[0], (300, 1, 1)), p=np.tile(poses.p[0], (300, 1)))
    rng = np.random.default_rng(3)
    series = []
    for known, old in zip(SENSORS, recording.series, strict=True):
        x = still.R[:1] @ known.t_lidar_mag + still.p[:1]
        b = np.einsum("nji,nj->ni", still.R[:1], STRONG.field_and_gradient(x)[0])
        field = known.distortion.apply(b) + rng.normal(0, NOISE, (300, 3))
        series.append(replace(old, field=field))
    every = OPTIONS.sync.model_copy(update={"thin_distance_m": 0.0, "thin_angle_deg": 0.0})
    options = OPTIONS.model_copy(update={"sync": every})
    parked = replace(recording, trajectory=still, series=tuple(series))
    found = validate(parked, STRONG, calibrated(), options, 1e-3)
    verdict = judged(found)
    assert verdict.level == "warn"
    assert "cannot rule out a change that would FAIL: its" in text_of(verdict, "mag_0")


@pytest.mark.parametrize(("less", "more"), [(0.1, 1.0), (1.0, 10.0)])
def test_looser_thresholds_never_judge_worse(less: float, more: float) -> None:
    found, ranks = on_drive(other_drive(changed(1, H=np.array([1.0, 0, 0])))), []
    for factor in (less, more):
        own = {
            name: Limit(warn=factor * value.warn, fail=factor * value.fail)
            for name, value in QA.validation
            if isinstance(value, Limit)
        }
        options = QA.model_copy(update={"validation": QA.validation.model_copy(update=own)})
        verdict = judged(found, options)
        ranks.append(["pass", "warn", "fail"].index(verdict.level))
    assert ranks[1] <= ranks[0]


@pytest.fixture(scope="module")
def whole() -> Validation:
    drive = on_drive(other_drive(changed(1, H=np.array([3.0, 0, 0]))))
    old = replace(calibrated(), bag=SourceFile("old.bag", "00"))
    comparison = compare_calibrations(calibrated(), old, 1e-3)
    verdict = judge_validation(drive, comparison, QA)
    sources = (NamedSource("drive", "other.bag", "ef56"),)
    return Validation(
        verdict, drive, comparison, validation_thresholds(QA), sources, {"l2m-gtsam": "0"}
    )


def test_a_validation_comes_back_as_it_was(whole: Validation, tmp_path: Path) -> None:
    write_validation(tmp_path / "first.json", whole)
    back = validation_in(tmp_path / "first.json")
    write_validation(tmp_path / "second.json", back)
    assert (tmp_path / "first.json").read_bytes() == (tmp_path / "second.json").read_bytes()


def test_what_changed_at_the_place_comes_back(whole: Validation, tmp_path: Path) -> None:
    a = np.arange(3.0)
    source = ChangedSource(a, a + 1, a + 2, a + 3, a + 4, 100.0, 0.8, 4.7, 2)
    told = (WhatChanged("the place changed", 90.0, True), WhatChanged("both", 80.0, True))
    assert whole.drive is not None
    drive = replace(whole.drive, sources=(source,), explanations=told)
    write_validation(tmp_path / "first.json", replace(whole, drive=drive))
    back = validation_in(tmp_path / "first.json").drive
    assert back is not None
    assert back.explanations == told
    np.testing.assert_array_equal(back.sources[0].moment, source.moment)


def test_keys_of_the_file_are_those_of_earlier_versions(whole: Validation, tmp_path: Path) -> None:
    path = tmp_path / "validation.json"
    write_validation(path, whole)
    content = json.loads(path.read_text())["validation"]
    assert set(content["verdict"]) == {"level", "remarks", "sensors"}
    assert set(content["verdict"]["sensors"][0]) == {"sensor", "level", "remarks"}
    assert set(content["verdict"]["sensors"][0]["remarks"][0]) == {"level", "text"}
    assert "noticeable" in content["drive"]["sensors"][0]
    assert validation_in(path).verdict == whole.verdict

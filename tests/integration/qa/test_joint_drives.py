"""Several drives calibrated together: beside each by itself, in any order, and after a knock."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.batch.reports import REPORT_FILE, write_report
from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.calibrate import calibrate, calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Recording, SourceFile
from l2m_gtsam.qa.evaluate import by_drive, evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.recording.joining import joined
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.records.error_budget import ErrorCause, StatedSize
from l2m_gtsam.records.map_diary import UNDATED
from l2m_gtsam.records.provenance import MapOrigin, NamedSource
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.record_files import read_metrics, write_metrics
from tests.drives.degenerate import STRONG, at_height, poses
from tests.drives.joint import DAY_NS, OPTIONS, Made, knocked, made, monday, recorded, tuesday, way
from tests.drives.moving import moving_drive
from tests.drives.moving import options as moving_options
from tests.drives.uncertain import surveyed
from tests.drives.verdict import NOISE, NOMINAL, SENSORS

# With noise that is given and exact poses and clocks the optimum is a matter of the readings alone.
PLAIN = CalibrationOptions(
    start=NOMINAL, solve=OneKeyOptions(sensor_noise_ut=NOISE, largest_offset_s=0.0)
)


@pytest.fixture(scope="module")
def good() -> Made:
    return made(monday(), tuesday())


def test_together_is_the_optimal_combination() -> None:
    """Of independent drives on an exact map: the mean weighted by the information of each.

    Each calibration stops within a hundredth of a sigma of its optimum. The model is bilinear in
    C and the field at t: second-order terms move the mean by a few hundredths of the joint sigma.
    """
    first, second = monday(), tuesday()
    one, other = (calibrate(each, STRONG, PLAIN) for each in (first, second))
    both = calibrate(joined([first, second]), STRONG, PLAIN)
    for sensor in NOMINAL:
        weights = [np.linalg.inv(each[sensor].covariance) for each in (one, other)]
        covariance = np.linalg.inv(sum(weights, np.zeros((15, 15))))
        pairs = zip(weights, (one, other), strict=True)
        mean = covariance @ sum((W @ each[sensor].vector() for W, each in pairs), np.zeros(15))
        sigma = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose((both[sensor].vector() - mean) / sigma, 0, atol=0.1)
        np.testing.assert_allclose(
            both[sensor].covariance / np.outer(sigma, sigma),
            covariance / np.outer(sigma, sigma),
            atol=0.03,
        )
        for each in (one, other):
            alone = np.sqrt(np.diag(each[sensor].covariance))
            assert (np.sqrt(np.diag(both[sensor].covariance)) < alone).all()


def test_the_order_of_bags_does_not_matter() -> None:
    """Not a bit: drives are put in order of time before anything is computed."""
    one, other = (
        calibrate(joined(drives), STRONG, PLAIN)
        for drives in ((monday(), tuesday()), (tuesday(), monday()))
    )
    assert [each.path for each in one.bags] == ["drives/monday.bag", "drives/tuesday.bag"]
    assert one.bags == other.bags
    for a, b in zip(one.sensors, other.sensors, strict=True):
        np.testing.assert_array_equal(a.t_lidar_mag, b.t_lidar_mag)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_the_names_of_drives_do_not_matter_where_clocks_start_alike() -> None:
    """Then digests put them in order; the other order gives the same within rounding and stops.

    Each solve stops within a hundredth of a sigma of the optimum.
    """
    here = replace(tuesday(), trajectory=way(0.4, 0))
    stamps = here.trajectory.stamp_ns
    here = replace(here, series=tuple(replace(each, stamp_ns=stamps) for each in here.series))
    first, last = (
        replace(here, source=SourceFile("drives/other.bag", digest)) for digest in ("0", "zz")
    )
    one, other = (calibrate(joined([monday(), each]), STRONG, PLAIN) for each in (first, last))
    assert [each.path for each in one.bags] != [each.path for each in other.bags]
    for sensor in NOMINAL:
        sigma = np.sqrt(np.diag(one[sensor].covariance))
        away = (one[sensor].vector() - other[sensor].vector()) / sigma
        np.testing.assert_allclose(away, 0, atol=0.02)


def test_good_drives_pass_and_repeat(good: Made) -> None:
    assert good.verdict.level is Level.PASS, good.verdict
    result = good.calibrated.result
    assert result.bag is None
    for known in SENSORS:
        assert result[known.sensor].status is SensorStatus.SOLVED
        found = good.metrics.get(known.sensor)
        assert found is not None
        assert found.drives is not None
        assert "several drives" in found.halves.reason
        assert [each.bag for each in found.drives.drives] == [each.path for each in result.bags]
        assert found.drives.freedom == 15
        # 99.99 % of such squares: of three sensors one is beyond in 0.03 % of seeds
        assert found.drives.squared < 44.3
        truth = known.vector()
        for each in found.drives.drives:
            ratio = (np.array(each.estimate) - truth) / np.array(each.sigma)
            assert np.abs(ratio).max() < 4.5


def test_a_sensor_that_moved_between_drives_is_named(good: Made) -> None:
    bad = made(monday(), tuesday(knocked()))
    levels = {each.sensor: each.level for each in bad.verdict.sensors}
    assert levels == {"mag_0": Level.PASS, "mag_1": Level.FAIL, "mag_2": Level.PASS}
    first = bad.verdict["mag_1"].reasons[0].text
    for words in ("between monday.bag and tuesday.bag", "other sensors repeat", "apart"):
        assert words in first
    found = bad.metrics.get("mag_1")
    assert found is not None
    assert found.drives is not None
    later = found.drives.drives[1].others
    # By the truth, to four of its sigmas: a day's 200 readings tell places to 5 mm only.
    away = np.array(later.difference[:3]) - [0.03, 0, 0]
    np.testing.assert_allclose(away / np.array(later.sigma[:3]), 0, atol=4)
    assert later.turned_deg == pytest.approx(np.rad2deg(0.05), abs=0.3)
    assert all(each.level is Level.PASS for each in bad.verdict.reasons)


def test_a_sensor_that_was_moved_is_not_blamed_on_map_and_poses() -> None:
    """What fits both drives fits neither. Where nothing is rejected the map explains nothing."""
    bad = made(monday(), tuesday(knocked()))
    left = [
        replace(each, fit=replace(each.fit, rms=(0.9 * each.fit.without_map,) * 3))
        if each.sensor == "mag_1"
        else each
        for each in bad.metrics.sensors
    ]
    metrics = replace(bad.metrics, sensors=tuple(left))
    stated = StatedSize(ErrorCause.POSES, 3.8, 400.0)
    result = replace(bad.calibrated.result, stated=(stated,))
    verdict = judge(result, metrics, QaOptions())
    first, *others = verdict["mag_1"].reasons
    assert "does not hold still" in first.text
    assert not any("explains" in each.text for each in others)
    (shared,) = [each.text for each in verdict.reasons if each.level is not Level.PASS]
    assert "larger by what mag_1 leaves" in shared


def test_of_three_drives_the_one_is_named() -> None:
    wednesday = recorded("wednesday", way(0.7, 2 * DAY_NS), 3)
    bad = made(monday(), tuesday(knocked()), wednesday)
    first = bad.verdict["mag_1"].reasons[0].text
    assert "it differs in tuesday.bag from the other drives" in first
    assert bad.verdict["mag_0"].level is Level.PASS


def test_a_drive_too_short_is_said() -> None:
    short = recorded("short", way(0.4, DAY_NS, count=20), 2)
    found = made(monday(), short)
    assert found.verdict.level is Level.PASS
    for each in found.verdict.sensors:
        (text,) = (why.text for why in each.reasons if "not compared" in why.text)
        assert text.startswith("short.bag is not compared")
        assert "usable readings in this drive are too few" in text


def test_a_turn_on_the_spot_is_no_movement_of_a_sensor() -> None:
    """It leaves the third column of C open, and t beside a C that no sensor has says nothing."""
    path = poses(np.linspace(0, 6.2, 200), at_height(np.zeros(200), np.zeros(200)))
    later = replace(path, stamp_ns=path.stamp_ns + DAY_NS)
    found = made(monday(), recorded("spot", later, 5))
    assert found.verdict.level is Level.PASS
    for sensor in found.verdict.sensors:
        (note,) = sensor.reasons
        assert note.text.startswith("spot.bag is not compared with the other drives: this drive")


def test_a_sensor_that_is_in_one_drive_only_is_calibrated_from_it() -> None:
    first, second = monday(), tuesday()
    second = replace(second, series=second.series[:2])
    found = made(first, second)
    assert found.calibrated.result["mag_2"].status is SensorStatus.SOLVED
    assert found.calibrated.result["mag_2"].missing_in == ("drives/tuesday.bag",)
    assert found.calibrated.result["mag_0"].missing_in == ()
    own = found.metrics.get("mag_2")
    assert own is not None
    assert own.drives is not None
    assert "nothing usable was read" in own.drives.drives[1].reason


def test_a_changed_place_is_told_with_the_drive_and_its_own_time() -> None:
    """Steel beside the way of the second drive only."""
    steel = STRONG.with_dipoles(np.array([2.0, 1.5, 0.0]), np.array([15.0, 10.0, 20.0]))
    found = made(monday(), recorded("tuesday", way(0.4, DAY_NS), 2, place=steel))
    stretches = found.calibrated.result.disagreements
    assert stretches
    own = way(0.4, DAY_NS).stamp_ns
    for each in stretches:
        assert each.bag == "drives/tuesday.bag"
        assert own[0] <= each.start_ns <= each.end_ns <= own[-1]
    assert "on the map in tuesday.bag" in found.verdict.reasons[0].text


def test_series_have_the_time_of_their_drive(good: Made) -> None:
    series = good.metrics.sensors[0].series
    assert series.drive is not None
    seconds, drive = np.array(series.seconds), np.array(series.drive)
    lasts = 1e-9 * (way(0, 0).stamp_ns[-1] - way(0, 0).stamp_ns[0])
    for k in range(2):
        own = seconds[drive == k]
        assert (np.diff(own) > 0).all()
        assert 0 <= own[0] < 1
        assert own[-1] <= lasts


def test_files_come_back_as_they_were(good: Made, tmp_path: Path) -> None:
    result = good.calibrated.result
    write_calibration(tmp_path / "a.yaml", result)
    back = read_calibration(tmp_path / "a.yaml")
    assert back.bags == result.bags
    assert back.drives == result.bags
    assert back.bag is None
    write_calibration(tmp_path / "b.yaml", back)
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    write_metrics(tmp_path / "a.json", good.metrics)
    write_metrics(tmp_path / "b.json", read_metrics(tmp_path / "a.json"))
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_the_page_shows_each_drive(good: Made, tmp_path: Path) -> None:
    write_report(tmp_path, good.calibrated.result, good.metrics, QaOptions())
    page = (tmp_path / REPORT_FILE).read_text()
    assert page.count("<figure>") == 4 + 3 * 8
    for words in (
        "Repeatability between drives",
        "Each drive by itself",
        "2 drives of",
        "drives/monday.bag",
        "digest of tuesday",
        "drive 2",
    ):
        assert words in page, words


def test_files_of_one_drive_do_not_speak_of_several(tmp_path: Path) -> None:
    """They are those of versions that knew one drive only."""
    one = monday()
    found = calibrated(joined([one]), STRONG, OPTIONS)
    write_calibration(tmp_path / "c.yaml", found.result)
    metrics = evaluate(one, found, OPTIONS, QaOptions(halves=False))
    write_metrics(tmp_path / "m.json", metrics)
    text = (tmp_path / "c.yaml").read_text()
    for name in ("\nbags:", "missing_in:"):
        assert name not in text
    json = (tmp_path / "m.json").read_text()
    for name in ('"bags"', '"drives"', '"drive":['):
        assert name not in json
    write_report(tmp_path, found.result, metrics, QaOptions())
    assert "between drives" not in (tmp_path / REPORT_FILE).read_text()


def test_drives_share_the_errors_of_the_map() -> None:
    """Two drives over one uncertain map, with uncertain poses.

    Together they are surer than each, and the comparison is within what chance allows.
    """
    whole = moving_drive(3, (0.0,)).silent
    first, second = (cut(whole, rows, k) for k, rows in enumerate((slice(0, 250), slice(250, 500))))
    field_map = surveyed(1)
    options = moving_options(moving_drive(3, (0.0,)))
    noise = PoseNoiseOptions(position_m=0.002, rotation_deg=0.05, correlation_s=5.0)
    solve = options.solve.model_copy(update={"pose_noise": noise, "largest_offset_s": 0.0})
    options = options.model_copy(update={"solve": solve})
    recording = joined([first, second])
    found = calibrated(recording, field_map, options)
    metrics = evaluate(recording, found, options, QaOptions())
    (sensor,), (figures,) = found.result.sensors, metrics.sensors
    assert figures.drives is not None
    assert figures.drives.freedom == 15
    # 99.99 % of such squares
    assert figures.drives.squared < 44.3
    pair = np.array([each.sigma for each in figures.drives.drives])
    assert (np.sqrt(np.diag(sensor.covariance)) < pair.min(axis=0)).all()
    knots = by_drive(found.solution.readings, 2)
    assert knots.sensors == ("mag_00 of drive 1", "mag_00 of drive 2")


def cut(whole: Recording, rows: slice, number: int) -> Recording:
    """Return a part of a drive as one of its own, a day later each."""
    path, later = whole.trajectory, number * DAY_NS
    stamps = path.stamp_ns[rows] + later
    series = tuple(
        replace(each, stamp_ns=each.stamp_ns[rows] + later, field=each.field[rows])
        for each in whole.series
    )
    trajectory = replace(path, stamp_ns=stamps, R=path.R[rows], p=path.p[rows])
    return Recording(trajectory, series, SourceFile(f"{number}.bag", str(number)))


def test_a_map_that_was_made_from_one_of_the_drives_is_named(good: Made) -> None:
    """Its noise is in both, and a sensor that surveyed comes out as it was assumed."""
    monday_, tuesday_ = good.calibrated.result.bags
    suite = NamedSource("suite", "suite.yaml", "of a suite")
    for source, level in ((tuesday_, Level.WARN), (suite, Level.PASS)):
        bag = NamedSource("bag", source.path, source.sha256)
        origin = MapOrigin(UNDATED, sources=(bag,))
        result = replace(good.calibrated.result, map_origin=origin)
        verdict = judge(result, good.metrics, QaOptions())
        assert verdict.level is level
        named = [each.text for each in verdict.reasons if "The map was made from" in each.text]
        assert [tuesday_.path in each for each in named] == [True] * (level is Level.WARN)
        assert not any(monday_.path in each for each in named)

"""Drives joined to one recording: every time comes back, and nothing reaches over a joint."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag

from l2m_gtsam.calibration.calibrate import prepare
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.pose_errors import PoseKnots
from l2m_gtsam.data import (
    FieldSeries,
    FloatArray,
    Readings,
    Recording,
    ScalarSeries,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.errors import CalibrationError, SyncError
from l2m_gtsam.qa.metrics.assemble import drive_metrics
from l2m_gtsam.qa.metrics.fit import correlation
from l2m_gtsam.recording.joining import drive_at, joined, own_ns
from l2m_gtsam.recording.sync import stuck_readings, with_offsets
from l2m_gtsam.records.sensor_models import Samples
from l2m_gtsam.solve.model_comparison import correlation_of, segments_of
from l2m_gtsam.solve.profile import interpolated
from l2m_gtsam.solve.robust import LATER_S
from tests.support.knots import left_open

STEP_NS = 50_000_000
GPS = 1_700_000_000_000_000_000
STARTS = st.sampled_from([0, 1, 1_000_000_000, GPS, GPS + 10_000_000_000, 4 * GPS])


def drive(
    start_ns: int, number: int, count: int = 40, sensors: tuple[str, ...] = ("mag_0", "mag_1")
) -> Recording:
    """Return a drive at x = 100 times its number, whose readings hold that number."""
    rng = np.random.default_rng(number)
    stamps = start_ns + STEP_NS * np.arange(count)
    p = np.column_stack([np.full(count, 100.0 * number), 0.1 * np.arange(count), np.zeros(count)])
    poses = Trajectory(stamps, np.tile(np.eye(3), (count, 1, 1)), p, "map", "lidar")
    series = tuple(
        FieldSeries(name, f"/{name}", "mag", stamps, number + 0.1 * rng.normal(size=(count, 3)))
        for name in sensors
    )
    return Recording(poses, series, SourceFile(f"{number}.bag", f"digest {number}"))


DRIVES = st.lists(STARTS, min_size=2, max_size=4).map(
    lambda starts: [drive(start, k) for k, start in enumerate(starts)]
)


def test_a_single_drive_is_left_as_it_is() -> None:
    one = drive(GPS, 0)
    assert joined([one]) is one
    assert one.parts == (one,)
    assert own_ns(one, 17) == 17


@given(DRIVES, st.randoms())
@settings(max_examples=30, deadline=None)
def test_the_order_of_drives_does_not_matter(drives: list[Recording], random: object) -> None:
    mixed = list(drives)
    random.shuffle(mixed)  # type: ignore[attr-defined]  # untyped
    one, other = joined(drives), joined(mixed)
    assert [each.source for each in one.drives] == [each.source for each in other.drives]
    assert one.source == other.source
    np.testing.assert_array_equal(one.trajectory.stamp_ns, other.trajectory.stamp_ns)
    np.testing.assert_array_equal(one.trajectory.p, other.trajectory.p)
    for a, b in zip(one.series, other.series, strict=True):
        np.testing.assert_array_equal(a.field, b.field)


@given(DRIVES)
@settings(max_examples=30, deadline=None)
def test_every_time_comes_back(drives: list[Recording]) -> None:
    whole = joined(drives)
    starts = [int(each.trajectory.stamp_ns[0]) for each in whole.drives]
    assert starts == sorted(starts)
    for k, (each, by) in enumerate(zip(whole.drives, whole.moved_ns, strict=True)):
        for stamp in (int(s) for s in each.trajectory.stamp_ns):
            assert drive_at(whole, stamp + by) == k
            assert own_ns(whole, stamp + by) == stamp


@given(DRIVES)
@settings(max_examples=30, deadline=None)
def test_drives_follow_each_other_after_a_pause(drives: list[Recording]) -> None:
    """Long enough for everything that looks for one, short enough for seconds in floating point."""
    whole = joined(drives)
    ends = [
        (int(each.trajectory.stamp_ns[0]) + by, int(each.trajectory.stamp_ns[-1]) + by)
        for each, by in zip(whole.drives, whole.moved_ns, strict=True)
    ]
    pauses = [after[0] - before[1] for before, after in pairwise(ends)]
    assert all(2 * LATER_S * 1e9 < pause < 3600e9 for pause in pauses)
    assert (np.diff(whole.trajectory.stamp_ns) > 0).all()


@given(DRIVES, st.floats(-29, 29))
@settings(max_examples=30, deadline=None)
def test_no_pose_lies_between_two_drives(drives: list[Recording], offset: float) -> None:
    """At any time offset up to half a pause a pose is the drive's own or that of its end."""
    whole = joined(drives)
    readings = prepare(whole, CalibrationOptions()).readings
    moved = with_offsets(readings, whole.trajectory, np.full(2, offset))
    here = np.array([each.trajectory.p[0, 0] for each in whole.drives])
    # exactly, as all poses of a drive have the same x
    np.testing.assert_array_equal(moved.p_map_lidar[:, 0], here[readings.of_drive])


@given(DRIVES)
@settings(max_examples=20, deadline=None)
def test_readings_are_those_of_each_drive_by_itself(drives: list[Recording]) -> None:
    """Thinned drive by drive, too: a place that another drive read does not count as read."""
    options = CalibrationOptions()
    whole = joined(drives)
    found = prepare(whole, options)
    parts = [prepare(each, options) for each in whole.drives]
    for k, part in enumerate(parts):
        own = found.readings.select(found.readings.of_drive == k)
        np.testing.assert_array_equal(own.stamp_ns - whole.moved_ns[k], part.readings.stamp_ns)
        np.testing.assert_array_equal(own.field, part.readings.field)
        np.testing.assert_array_equal(own.R_map_lidar, part.readings.R_map_lidar)
        assert own.motion is not None
        assert part.readings.motion is not None
        np.testing.assert_array_equal(own.motion.twist_lidar, part.readings.motion.twist_lidar)
    assert found.counts[0].kept == sum(each.counts[0].kept for each in parts)
    order = np.lexsort((found.readings.stamp_ns, found.readings.sensor))
    np.testing.assert_array_equal(order, np.arange(len(order)))


def test_the_same_way_driven_twice_is_read_twice() -> None:
    first, later = drive(GPS, 0), drive(2 * GPS, 0)
    field = first.series[0].field + 1.0
    series = tuple(replace(each, field=field) for each in later.series)
    again = replace(later, series=series, source=SourceFile("again.bag", "other"))
    one = prepare(first, CalibrationOptions()).readings
    both = prepare(joined([first, again]), CalibrationOptions()).readings
    assert len(both) == 2 * len(one)


def test_a_sensor_may_be_missing_in_a_drive() -> None:
    whole = joined([drive(GPS, 0), drive(GPS + 10, 1, sensors=("mag_1", "mag_2"))])
    found = prepare(whole, CalibrationOptions())
    assert found.readings.sensors == ("mag_0", "mag_1", "mag_2")
    of = {
        name: set(found.readings.of_drive[found.readings.rows_of(k)].tolist())
        for k, name in enumerate(found.readings.sensors)
    }
    assert of == {"mag_0": {0}, "mag_1": {0, 1}, "mag_2": {1}}


def test_a_sensor_that_is_stuck_in_one_drive_is_read_in_the_other() -> None:
    first, second = drive(GPS, 0), drive(GPS, 1)
    still = replace(second.series[0], field=np.ones_like(second.series[0].field))
    whole = joined([first, replace(second, series=(still, second.series[1]))])
    readings = prepare(whole, CalibrationOptions()).readings
    stuck = stuck_readings(readings)
    np.testing.assert_array_equal(stuck, (readings.sensor == 0) & (readings.of_drive == 1))


def numbered(number: int, values: FloatArray) -> Recording:
    """Return a drive with a recorded number."""
    bare = drive(GPS + number, number)
    return replace(bare, scalars=(ScalarSeries("motor", "/m", bare.trajectory.stamp_ns, values),))


def test_a_number_may_rest_in_one_drive_if_it_differs_in_another() -> None:
    off, on = np.zeros(40), np.ones(40)
    found = prepare(joined([numbered(0, off), numbered(1, on)]), CalibrationOptions()).readings
    assert found.regressors is not None
    np.testing.assert_array_equal(found.regressors[:, 0], found.of_drive)
    for drives in ([numbered(0, off)], [numbered(0, off), numbered(1, off)]):
        with pytest.raises(SyncError, match="'motor': it is 0 at all readings"):
            prepare(joined(drives), CalibrationOptions())


def test_one_drive_with_uncertain_poses_leaves_the_other_exact() -> None:
    first, second = drive(GPS, 0), drive(GPS, 1)
    known = replace(first.trajectory, covariance=np.tile(1e-4 * np.eye(6), (40, 1, 1)))
    whole = joined([replace(first, trajectory=known), second])
    found = prepare(whole, CalibrationOptions()).readings
    assert found.pose_root is not None
    uncertain = found.pose_root.any(axis=(1, 2))
    np.testing.assert_array_equal(uncertain, found.of_drive == 0)


def other_sensor(known: Recording, path: str) -> Recording:
    """Return a drive's table of another sensor that is called the same."""
    series = tuple(replace(each, field=each.field + 1.0) for each in known.series)
    return replace(known, series=series, source=SourceFile(path, "other"))


def test_parts_of_a_drive_with_one_file_of_poses_are_drives() -> None:
    whole = drive(GPS, 0)
    halves = [
        replace(
            whole,
            series=tuple(
                replace(each, stamp_ns=each.stamp_ns[rows], field=each.field[rows])
                for each in whole.series
            ),
            source=SourceFile(f"{rows}", f"{rows}"),
        )
        for rows in (slice(0, 20), slice(20, 40))
    ]
    assert len(joined(halves).drives) == 2


def part(whole: Recording, first: int, end: int) -> Recording:
    """Return a log with some of the poses and readings of a drive."""
    rows = np.arange(first, end)
    series = tuple(
        replace(each, stamp_ns=each.stamp_ns[rows], field=each.field[rows]) for each in whole.series
    )
    source = SourceFile(f"{first}_to_{end}.bag", f"digest {first} {end}")
    return replace(whole, trajectory=whole.trajectory[rows], series=series, source=source)


def test_logs_that_overlap_are_refused() -> None:
    """Their common readings would count twice: sigmas would be too small."""
    whole = drive(GPS, 0)
    assert len(joined([part(whole, 0, 25), part(whole, 25, 40)]).drives) == 2
    for logs in (
        [part(whole, 0, 25), part(whole, 15, 40)],
        [whole, part(whole, 5, 30)],
        [part(whole, 20, 40), drive(2 * GPS, 1), whole],
    ):
        with pytest.raises(CalibrationError, match="are the same drive, or overlap: the same"):
            joined(logs)


def test_copies_of_a_log_with_missing_readings_are_refused() -> None:
    """Of some drivers every second message is not a number."""
    whole = drive(GPS, 0)
    field = whole.series[0].field.copy()
    field[::2] = np.nan
    one = replace(whole, series=(replace(whole.series[0], field=field),))
    copy = replace(one, source=SourceFile("copy.mcap", "another digest"))
    with pytest.raises(CalibrationError, match="are the same drive, or overlap"):
        joined([one, copy])


def test_clocks_that_start_alike_and_stuck_sensors_are_no_overlap() -> None:
    """Of the same times, and a sensor repeats one value in both, or coarse ones now and then."""
    first, second = drive(0, 0), drive(0, 1)
    still = np.ones_like(first.series[0].field)
    stuck = [
        replace(each, series=(replace(each.series[0], field=still), each.series[1]))
        for each in (first, second)
    ]
    assert len(joined(stuck).drives) == 2
    # Steps of 0.3 beside noise of 0.1: few values, many of them alike.
    coarse = [
        replace(
            each,
            series=tuple(
                replace(s, field=0.3 * np.round((s.field - k) / 0.3)) for s in each.series
            ),
        )
        for k, each in enumerate((first, second))
    ]
    assert len(joined(coarse).drives) == 2


@pytest.mark.parametrize(
    ("drives", "pattern"),
    [
        ([], "no drive is given"),
        ([drive(0, 0), drive(0, 0)], "0.bag and 0.bag are the same drive"),
        (
            [drive(0, 0), replace(drive(0, 0), source=SourceFile("copy.mcap", "other"))],
            "0.bag and copy.mcap are the same drive",
        ),
        (
            [drive(0, 0), other_sensor(drive(0, 0), "rear.csv")],
            "0.bag and rear.csv have the same poses.*: they are one drive, not two; put the read",
        ),
        (
            [drive(0, 0), replace(drive(0, 0, sensors=("left",)), source=SourceFile("l.csv", ""))],
            "0.bag and l.csv have the same poses.*: they are one drive, not two; put the readings",
        ),
        (
            [drive(0, 0), drive(0, 1, sensors=("left", "right"))],
            r"0.bag: none of its sensors \(mag_0, mag_1\) is in another drive.* left, right",
        ),
        (
            [
                drive(0, 0),
                replace(drive(0, 1), trajectory=replace(drive(0, 1).trajectory, frame="odom")),
            ],
            "1.bag: its poses are in frame 'odom', those of 0.bag 'map'.*`bag.frame`",
        ),
        (
            [
                drive(0, 0),
                replace(drive(0, 1), trajectory=replace(drive(0, 1).trajectory, child_frame="cam")),
            ],
            "1.bag: its poses are those of 'cam', those of 0.bag 'lidar'",
        ),
        ([drive(0, 0), numbered(1, np.ones(40))], "1.bag: it has other recorded numbers"),
    ],
)
def test_drives_that_do_not_go_together_are_one_line(drives: list[Recording], pattern: str) -> None:
    with pytest.raises(CalibrationError, match=pattern) as error:
        joined(drives)
    assert "\n" not in str(error.value)


def test_pose_errors_of_two_drives_have_nothing_in_common() -> None:
    """Knots and bridges together give the covariance of Ornstein-Uhlenbeck processes, one a drive.

    The errors last as long as both drives and the pause together.
    """
    seconds = np.concatenate([np.linspace(0, 8, 17), np.linspace(68, 70, 5)])
    of, lasts = np.repeat([0, 1], [17, 5]), 70.0
    knots = PoseKnots.over(seconds, lasts, of)
    K = len(knots.seconds)
    step = np.zeros((K, K))
    step[0, 0] = 1.0
    for k, like in enumerate(knots.correlation):
        own = np.sqrt(1 - like**2)
        step[k + 1, k : k + 2] = [-like / own, 1 / own]
    of_knots = np.linalg.inv(step.T @ step)
    segment, weights = knots.segment(seconds), np.zeros((len(seconds), K))
    rows = np.arange(len(seconds))
    weights[rows, segment], weights[rows, segment + 1] = knots.weights(seconds).T
    bridges = [left_open(knots, seconds[segment == each]) for each in np.unique(segment)]
    found = weights @ of_knots @ weights.T + block_diag(*bridges)
    apart = np.abs(seconds[:, None] - seconds)
    expected = np.exp(-apart / lasts) * (of[:, None] == of)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_value_between_two_drives_is_not_interpolated() -> None:
    """Two sensors that read in turn, at one place, at the end of a drive and after it."""

    def at(stamps: list[int], drives: list[int]) -> Readings:
        n = len(stamps)
        none = np.zeros(n, dtype=np.int64)
        R, p = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
        return Readings(
            ("a",), none, np.array(stamps), R, p, np.ones((n, 3)), drive=np.array(drives)
        )

    own, asked = at([0, 10, 1000, 1010], [0, 0, 1, 1]), at([5, 15, 990, 1005], [0, 0, 1, 1])
    known = np.isfinite(interpolated(own, asked)).all(axis=1)
    np.testing.assert_array_equal(known, [True, False, False, True])


@given(st.integers(0, 1000), st.lists(st.integers(8, 60), min_size=1, max_size=4))
@settings(max_examples=30, deadline=None)
def test_correlations_are_those_within_drives(seed: int, sizes: list[int]) -> None:
    """Against plain loops."""
    series = np.random.default_rng(seed).normal(size=(sum(sizes), 3))
    of = np.repeat(np.arange(len(sizes)), sizes)
    centred, lags = series - series.mean(axis=0), 5
    slow = np.array(
        [
            sum(
                np.sum(own[: len(own) - k] * own[k:])
                for own in (centred[of == d] for d in range(len(sizes)))
            )
            for k in range(lags + 1)
        ]
    )
    np.testing.assert_allclose(correlation(series, lags, of), slow / slow[0], atol=1e-10)


def samples(sizes: list[int]) -> Samples:
    N = sum(sizes)
    none = np.zeros((N, 3))
    of = np.repeat(np.arange(len(sizes)), sizes)
    return Samples(none, none, none, np.empty((N, 0)), np.ones(N), (), of)


@given(st.lists(st.integers(1, 80), min_size=1, max_size=5), st.integers(3, 12))
@settings(deadline=None)
def test_segments_end_where_drives_end(sizes: list[int], segments: int) -> None:
    found = samples(sizes)
    segment = segments_of(found, segments)
    assert (np.diff(segment) >= 0).all()
    assert set(segment.tolist()) == set(range(int(segment[-1]) + 1))
    of = np.repeat(np.arange(len(sizes)), sizes)
    assert len(set(zip(segment.tolist(), of.tolist(), strict=True))) == int(segment[-1]) + 1
    if len(sizes) == 1 and sizes[0] >= segments:
        np.testing.assert_array_equal(segment, np.arange(sizes[0]) * segments // sizes[0])


def test_residuals_of_two_drives_are_not_correlated() -> None:
    """Two drives of opposite constant residuals: as like within as they are unlike beyond."""
    residual = np.repeat([1.0, -1.0], 50)[:, None] * np.ones((1, 3))
    apart = correlation_of(residual, samples([50, 50]).drives)
    np.testing.assert_allclose(apart[:50], 1 - np.arange(50) / 50, atol=1e-9)
    np.testing.assert_allclose(apart[50:], 0, atol=1e-9)


def test_the_way_between_two_drives_is_not_driven() -> None:
    first, second = drive(GPS, 0), drive(GPS, 1)
    one, both = drive_metrics(first), drive_metrics(joined([first, second]))
    assert both.length == pytest.approx(2 * one.length)
    assert both.seconds == pytest.approx(2 * one.seconds)
    path = np.array(both.path)
    assert np.isnan(path).all(axis=1).sum() == 1
    assert np.nanmax(np.linalg.norm(np.diff(path, axis=0), axis=1)) < 1

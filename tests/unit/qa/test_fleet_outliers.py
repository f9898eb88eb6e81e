"""Outliers and trends of a fleet: what is marked, and what never is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa import fleet as fleet_module
from l2m_gtsam.qa.fleet import (
    agreeing,
    expected_deviation,
    rotations_apart,
    with_outliers,
)
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.qa.report.figures.trends import trends, weighted_mean
from l2m_gtsam.records.fleet import FleetRow
from tests.drives.fleet_rows import row, sensor_row
from tests.support.memory import with_peak

OPTIONS = FleetOptions()
SIGMA = 0.002  # metres


def fleet(places: FloatArray, **changes: Any) -> list[FleetRow]:
    """Return drives of one vehicle that found a sensor at these places, shape (N, 3)."""
    sensors = [sensor_row(t=tuple(place), t_sigma=(SIGMA,) * 3, **changes) for place in places]
    return [row(day, sensor) for day, sensor in enumerate(sensors)]


def scattered(seed: int, count: int = 8) -> FloatArray:
    return 0.3 + np.random.default_rng(seed).uniform(-2, 2, (count, 3)) * SIGMA


@given(st.integers(0, 10_000))
def test_what_moved_is_marked_and_nothing_else(seed: int) -> None:
    """Moved by forty sigmas; the others scatter within two, four from each other at the most."""
    places = scattered(seed)
    moved = seed % len(places)
    places[moved, 1] += 40 * SIGMA
    marked = with_outliers(fleet(places), OPTIONS)
    assert [bool(each.outliers) for each in marked] == [k == moved for k in range(len(places))]
    (outlier,) = marked[moved].outliers
    assert outlier.parameter == "t_y (mm)"
    # off the median by the shift, to the scatter of both
    assert outlier.deviation == pytest.approx(80, abs=6e3 * SIGMA)
    assert outlier.score > OPTIONS.outlier


@given(st.integers(0, 10_000), st.integers(1, 9))
def test_a_sensor_that_was_displaced_between_drives_is_marked(seed: int, after: int) -> None:
    """Moved by twelve sigmas after the first drives, or the last ones: those that are fewer.

    The spread of both places together is several times that of either, and with as many drives
    before as after the median of all lies half way.
    """
    rng = np.random.default_rng(seed)
    # within one sigma, two from each other: so both places are apart by ten at least
    places = 0.3 + rng.uniform(-1, 1, (10, 3)) * SIGMA
    moved = np.arange(10) >= 10 - after
    places[moved, 0] += 12 * SIGMA
    marks = with_outliers(fleet(places), OPTIONS)
    marked = np.array([[o.parameter for o in each.outliers] == ["t_x (mm)"] for each in marks])
    either = (moved, ~moved) if after == 5 else (moved if after < 5 else ~moved,)
    assert any(np.array_equal(marked, each) for each in either)
    assert sum(bool(each.outliers) for each in marks) == marked.sum()


def test_normal_drives_are_hardly_ever_marked() -> None:
    """With true sigmas never; three times too small, in the shares that docs/fleet.md has.

    Of 2000 fleets: 1.5 % and 0.3 % are known to a tenth of themselves and to a fifth.
    """
    rng = np.random.default_rng(7)
    few, many = rng.normal(size=(2000, 5)), rng.normal(size=(2000, 20))
    for values, most in ((few, 0.02), (many, 0.004)):
        usual = np.array([agreeing(each) for each in values])
        shares = []
        for sigma in (1.0, 1 / 3):
            beyond = [
                np.abs(each - np.median(each[kept]))
                > OPTIONS.outlier * expected_deviation(each, np.full(len(each), sigma), kept)
                for each, kept in zip(values, usual, strict=True)
            ]
            shares.append(np.mean(beyond))
        assert shares[0] == 0
        assert shares[1] < most


def test_drives_that_differ_by_more_than_their_sigmas_say_are_not_all_marked() -> None:
    """Sigmas ten times too small: the spread is what counts."""
    places = 0.3 + np.random.default_rng(3).normal(0, 10 * SIGMA, (40, 3))
    assert not any(each.outliers for each in with_outliers(fleet(places), OPTIONS))


def test_a_drive_that_knows_little_is_not_marked() -> None:
    rows = fleet(scattered(1))
    assert rows[0].sensor is not None
    vague = replace(rows[0].sensor, t=(0.5, 0.3, 0.3), t_sigma=(0.1, 0.002, 0.002))
    marked = with_outliers([replace(rows[0], sensor=vague), *rows[1:]], OPTIONS)
    assert not marked[0].outliers


def test_what_is_not_determined_does_not_count() -> None:
    rows = fleet(scattered(1))
    assert rows[0].sensor is not None
    unknown = replace(rows[0].sensor, t=(9.0, 0.3, 0.3), t_sigma=(np.inf, 0.002, 0.002))
    marked = with_outliers([replace(rows[0], sensor=unknown), *rows[1:]], OPTIONS)
    assert not any(each.outliers for each in marked)


def test_three_drives_are_too_few() -> None:
    places = scattered(1, 3)
    places[0] += 1.0
    assert not any(each.outliers for each in with_outliers(fleet(places), OPTIONS))


def test_vehicles_are_not_mixed() -> None:
    """Two vehicles with their sensors at different places."""
    here, there = fleet(scattered(1)), fleet(scattered(2) + 0.5)
    other = [replace(each, vehicle="other") for each in there]
    assert not any(each.outliers for each in with_outliers([*here, *other], OPTIONS))


def test_a_turned_sensor_is_marked_about_its_axis() -> None:
    rows = fleet(scattered(1))
    turned = Rotation.from_euler("z", 3, degrees=True).as_quat(canonical=True)
    assert rows[2].sensor is not None
    rows[2] = replace(rows[2], sensor=replace(rows[2].sensor, quaternion_xyzw=tuple(turned)))
    marked = with_outliers(rows, OPTIONS)
    assert [each.parameter for each in marked[2].outliers] == ["rotation_z (deg)"]
    assert marked[2].outliers[0].deviation == pytest.approx(3.0)
    assert "rotation_z +3.00 deg" in str(marked[2].outliers[0])


@given(st.integers(0, 10_000))
def test_rotations_are_told_from_the_middle_one(seed: int) -> None:
    """Whatever the mounting: apart as they were made, and NaN where there is none."""
    rng = np.random.default_rng(seed)
    mounting = Rotation.random(random_state=seed)
    apart = rng.normal(0, 2, (5, 3))
    apart[0] = 0
    q = (mounting * Rotation.from_rotvec(apart, degrees=True)).as_quat(canonical=True)
    q = np.vstack([q, np.full(4, np.nan)])
    told = rotations_apart(q)
    assert np.isnan(told[5]).all()
    middle = int(np.argmin(np.linalg.norm(told[:5], axis=1)))
    back = mounting * Rotation.from_rotvec(apart[middle], degrees=True)
    for k in range(5):
        again = (back * Rotation.from_rotvec(told[k], degrees=True)).as_matrix()
        assert again == pytest.approx(Rotation.from_quat(q[k]).as_matrix(), abs=1e-9)


@given(st.integers(0, 10_000), st.integers(1, 40))
def test_the_middle_rotation_beside_one_found_by_trying_all(seed: int, count: int) -> None:
    R = Rotation.random(random_state=seed) * near(seed, count)
    sums = [sum((one.inv() * other).magnitude() for other in R) for one in R]
    told = rotations_apart(R.as_quat())
    (middle,) = np.flatnonzero(np.linalg.norm(told, axis=1) < 1e-9)
    # two that are equally near to all others, as with two rotations, may be taken for each other
    assert sums[middle] == pytest.approx(min(sums), abs=1e-9)


@given(st.integers(0, 1000))
def test_the_middle_of_a_sample_is_nearly_that_of_all(seed: int) -> None:
    """Forty of two hundred: both lie well inside the scatter of 2 degrees per axis."""
    q = near(seed, 200).as_quat()
    whole = rotations_apart(q)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fleet_module, "MOST", 40)
        sampled = rotations_apart(q)
        assert (sampled == rotations_apart(q)).all()
    between = (
        Rotation.from_rotvec(whole, degrees=True)
        * Rotation.from_rotvec(sampled, degrees=True).inv()
    )
    apart = np.rad2deg(between.magnitude())
    assert np.ptp(apart) < 1e-6  # one rotation, the same for all drives
    assert apart[0] < 3


def test_thousands_of_rotations_take_little_memory() -> None:
    q = near(1, 20_000).as_quat()
    _, peak = with_peak(lambda: rotations_apart(q))
    assert peak < 50e6  # each with each would be 3 GB


def near(seed: int, count: int) -> Rotation:
    """Return rotations by some 2 degrees about each axis."""
    apart = np.random.default_rng(seed).normal(0, 2, (count, 3))
    return Rotation.from_rotvec(apart, degrees=True)


@given(st.integers(4, 60), st.floats(1e-3, 1e3), st.integers(0, 1000))
def test_what_is_expected_scales_with_the_unit(count: int, scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    value, sigma = rng.normal(size=count), rng.uniform(0.1, 2, count)
    usual = agreeing(value)
    assert 2 * usual.sum() >= count
    np.testing.assert_array_equal(agreeing(scale * value), usual)
    expected = expected_deviation(value, sigma, usual)
    assert (expected >= sigma).all()
    assert expected_deviation(scale * value, scale * sigma, usual) == pytest.approx(
        scale * expected
    )


def test_the_weighted_mean_beside_a_sum_written_out() -> None:
    values, sigmas = np.array([[1.0, 5.0], [2.0, np.nan], [9.0, 7.0]]), np.full((3, 2), 2.0)
    sigmas[1, 0], sigmas[2, 1] = 1.0, np.inf
    counts = np.array([[True, True], [True, True], [False, True]])
    mean = (1 / 4 + 2 / 1) / (1 / 4 + 1)
    assert weighted_mean(values, sigmas, counts) == pytest.approx([mean, 5.0])
    assert np.isnan(weighted_mean(values, sigmas, np.zeros((3, 2), dtype=bool))).all()


def test_trends_are_in_order_of_time_and_leave_outliers_out_of_the_mean() -> None:
    places = scattered(5)
    places[3, 0] += 0.1
    rows = with_outliers(fleet(places), OPTIONS)
    (trend,) = trends(list(reversed(rows)))
    assert (np.diff(trend.days) > 0).all()
    assert trend.outliers == 1
    assert trend.outlying[3].tolist() == [True, False, False, False]
    others = np.delete(places[:, 0], 3)
    assert trend.values[:, 0] == pytest.approx(1e3 * (places[:, 0] - others.mean()))


def test_a_drive_without_a_date_has_no_place_in_a_trend() -> None:
    rows = [replace(each, date="") for each in fleet(scattered(1, 5))]
    assert trends(rows) == []


def test_rows_that_failed_are_left_alone() -> None:
    failed = FleetRow("truck", "b", "truck/b", "", 0.0, None, "broken")
    assert with_outliers([failed], OPTIONS) == (failed,)

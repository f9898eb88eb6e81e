"""Errors of the sensors that surveyed, carried by the map that was made of their readings."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.build import map_from_state
from l2m_gtsam.maps.harmonic import error_modes
from l2m_gtsam.maps.harmonic.error_modes import moved_weights
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.suite_sizes import shown
from l2m_gtsam.maps.suite_errors import SHIFT, SIZE, SuiteErrors
from l2m_gtsam.maps.training import cubes_of, errors_together, merged, training_set
from tests.worlds.harmonic import OPTIONS, POST, readings, within_survey

SIGMA = np.repeat([0.005, 0.01, 0.5, 0.002], [3, 9, 3, 1])


def errors(count: int, sensors: int = 2, seed: int = 0) -> SuiteErrors:
    """Return errors of so many readings, which sensors take in turn."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(SIZE * sensors, SIZE * sensors)) / np.sqrt(SIZE * sensors)
    root *= np.tile(SIGMA, sensors)[:, None]
    shift = rng.normal(size=(count, SHIFT, SIZE))
    names = tuple(f"s{i}" for i in range(sensors))
    return SuiteErrors(names, root @ root.T, np.arange(count), np.arange(count) % sensors, shift)


def effect(suite: SuiteErrors, count: int, slope: FloatArray) -> FloatArray:
    """Return what all errors do to the field of all readings, shape (N, 3, 16 S)."""
    return suite.of_field(np.arange(count), slope)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_averages_have_the_average_effect(seed: int, sensors: int) -> None:
    rng, count = np.random.default_rng(seed), 30
    suite = errors(count, sensors, seed)
    # Every average has a reading.
    owner = np.concatenate([np.arange(6), rng.integers(0, 6, count - 6)])
    weight, slope = rng.uniform(0.5, 5, count), rng.normal(size=(6, 3, 3))
    told = effect(suite.averaged(owner, weight), 6, slope)
    single = effect(suite, count, slope[owner])
    for each in range(6):
        own = owner == each
        expected = np.average(single[own], axis=0, weights=weight[own])
        np.testing.assert_allclose(told[each], expected, atol=1e-12)


def test_the_same_sensors_have_the_same_errors_in_two_surveys() -> None:
    one, other = errors(10), errors(5, seed=0)
    both = errors_together(one, other, 10)
    assert both is not None
    assert both.sensors == one.sensors
    strange = errors_together(one, errors(5, seed=1), 10)
    assert strange is not None
    assert len(strange.covariance) == 2 * len(one.covariance)
    assert errors_together(None, None, 10) is None
    late = errors_together(None, other, 10)
    assert late is not None
    np.testing.assert_array_equal(late.reading, other.reading + 10)


@pytest.fixture(scope="module")
def uncertain() -> HarmonicMap:
    points, field = readings()
    return HarmonicMap.fit(points, field, OPTIONS, POST, errors(len(points)))


def test_the_map_moves_as_its_errors_say(uncertain: HarmonicMap) -> None:
    """The posterior means of wrong readings, computed, against the features: linear algebra."""
    points, field = readings()
    # Large ones, so that a drive feels all combinations: the posterior mean is linear.
    suite, learnt = errors(len(points)), uncertain.learnt
    suite = replace(suite, covariance=1e8 * suite.covariance)
    # Readings are changed as they were taken; positions stay, whose shift is a change of field.
    still = replace(suite, shift=np.concatenate([0 * suite.shift[:, :3], suite.shift[:, 3:]], 1))
    ours = HarmonicMap.fit(points, field, OPTIONS, POST, still)
    unit = np.random.default_rng(2).normal(size=SIZE * 2)
    squares, turned = np.linalg.eigh(suite.covariance)
    eta = turned @ (np.sqrt(np.maximum(squares, 0)) * unit)
    raw = training_set(points, field)
    wrong = merged(raw, OPTIONS.merge, OPTIONS.independent).field + (
        still.averaged(cubes_of(points, OPTIONS.merge), raw.weight).of_field(
            np.arange(len(learnt.readings)), np.zeros((len(learnt.readings), 3, 3))
        )
        @ eta
    )
    moved = HarmonicMap.condition(
        replace(learnt, readings=replace(learnt.readings, field=wrong)), OPTIONS
    )
    at = within_survey()
    told, owner = ours.errors_over(at), ours.learnt.tiling.grid.block_of(at)
    # Unit variances and errors are a rotation apart.
    assert len(told.spread) == len(eta)
    seen = np.concatenate([told.common_features(at[owner == i], i) for i in told.sizes()])
    changed = np.concatenate(
        [
            moved.tiles[i].field_and_gradient(at[owner == i])[0]
            - ours.tiles[i].field_and_gradient(at[owner == i])[0]
            for i in told.sizes()
        ]
    )
    unitary, *_ = np.linalg.lstsq(seen.reshape(-1, len(told.spread)), changed.ravel(), rcond=None)
    np.testing.assert_allclose(seen @ unitary, changed, atol=1e-6 * np.abs(changed).max())
    # The numbers that make this change are as likely as the errors they come from.
    assert unitary @ unitary == pytest.approx(unit @ unit, rel=1e-5)


def test_what_they_do_to_a_tile_is_found_once(
    uncertain: HarmonicMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever drive asks: it is the map's."""
    fresh = HarmonicMap.condition(uncertain.learnt, uncertain.options)
    asked, at = list[int](), within_survey()

    def counted(*given: Any) -> FloatArray:
        asked.append(given[2])
        return moved_weights(*given)

    monkeypatch.setattr(error_modes, "moved_weights", counted)
    first, again = fresh.errors_over(at), fresh.errors_over(at)
    assert sorted(asked) == sorted(first.sizes())
    there = pickle.loads(pickle.dumps(fresh)).errors_over(at)  # noqa: S301 - our own
    for tile in first.sizes():
        expected = first.common_features(at, tile)
        np.testing.assert_array_equal(again.common_features(at, tile), expected)
        np.testing.assert_array_equal(there.common_features(at, tile), expected)


def test_a_shift_of_all_readings_moves_the_map_as_it_is() -> None:
    points, field = readings()
    shift = np.zeros((len(points), SHIFT, SIZE))
    shift[:, 2, 2] = 1.0  # all heights alike
    covariance = np.zeros((SIZE, SIZE))
    covariance[2, 2] = 0.1**2
    every = np.arange(len(points))
    suite = SuiteErrors(("mag",), covariance, every, 0 * every, shift)
    ours = HarmonicMap.fit(points, field, OPTIONS, POST, suite).compile()
    at = within_survey()
    told, owner = ours.errors_over(at), ours.learnt.tiling.grid.block_of(at)
    # Two millimetres at a time, over which fields are linear; fifty of them are its deviation.
    np.testing.assert_allclose(told.spread, [50.0])
    np.testing.assert_allclose(np.abs(told.shift), np.array([[0.0], [0.0], [0.002]]), atol=1e-15)
    _, gradient = ours.field_and_gradient(at)
    for index in told.sizes():
        seen = told.common_features(at[owner == index], index)
        assert np.abs(seen).max() < 1e-12 * np.abs(gradient).max()


def test_errors_that_no_drive_feels_are_left_out() -> None:
    points, field = readings()
    small = errors(len(points))
    small = replace(small, covariance=1e-12 * small.covariance)
    ours = HarmonicMap.fit(points, field, OPTIONS, POST, small)
    assert ours.errors_over(within_survey()).spread.size == 0


def test_a_map_keeps_its_errors(uncertain: HarmonicMap) -> None:
    again = map_from_state(uncertain.to_state())
    assert isinstance(again, HarmonicMap)
    assert again.learnt.suite is not None
    assert again.learnt.suite.sensors == ("s0", "s1")
    at = within_survey(20)
    one, other = uncertain.errors_over(at), again.errors_over(at)
    assert len(one.spread) == len(other.spread)
    for index in one.sizes():
        here = at[one.owner(at) == index]
        a, b = (each.common_features(here, index) for each in (one, other))
        # Kept with seven digits; the sign of a combination is nobody's.
        one_cov, other_cov = (each @ each.transpose(0, 2, 1) for each in (a, b))
        np.testing.assert_allclose(one_cov, other_cov, rtol=1e-5, atol=1e-9)


def test_more_readings_keep_the_errors_of_the_old_ones(uncertain: HarmonicMap) -> None:
    points, field = readings(50, seed=4)
    exact = uncertain.updated(points, field)
    assert exact.learnt.suite is not None
    assert exact.learnt.suite.reading.max() < len(exact.learnt.readings)
    same = uncertain.updated(points, field, errors(len(points)))
    assert same.learnt.suite is not None
    assert same.learnt.suite.sensors == ("s0", "s1")
    # Readings of the old cubes and of the new ones: all have a share in the errors.
    assert len(np.unique(same.learnt.suite.reading)) == len(same.learnt.readings)


def damage(state: MapState, **arrays: FloatArray) -> MapState:
    return replace(state, arrays={**state.arrays, **arrays})


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("suite_covariance", lambda a: a[:-1]),
        ("suite_covariance", lambda a: a * np.nan),
        ("suite_covariance", lambda a: -a),
        ("suite_covariance", lambda a: a + np.triu(a, 1)),
        ("suite_pairs", lambda a: a - 1),
        ("suite_pairs", lambda a: a + 10**6),
        ("suite_pairs", lambda a: a[0]),
        ("suite_pairs", lambda a: a + 0.5),
        ("suite_shift", lambda a: a[1:]),
        ("suite_shift", lambda a: a * np.inf),
    ],
)
def test_a_damaged_suite_is_refused_in_one_line(
    uncertain: HarmonicMap, name: str, change: object
) -> None:
    state = uncertain.to_state()
    assert callable(change)
    with np.errstate(invalid="ignore"), pytest.raises(MapError, match="suite is") as refused:
        map_from_state(damage(state, **{name: change(state.arrays[name])}))
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def wrong_by() -> FloatArray:
    """Errors of C and H of two sensors, each an independent draw of its sigmas, shape (32,)."""
    sigma = np.where(np.arange(SIZE) < 3, 0.0, SIGMA) * (np.arange(SIZE) < SIZE - 1)
    return np.asarray(np.random.default_rng(3).standard_normal(2 * SIZE) * np.tile(sigma, 2))


@pytest.fixture(scope="module")
def found(wrong_by: FloatArray) -> HarmonicMap:
    """The map of two sensors that are off, whose sigmas are stated."""
    points, field = readings()
    suite = independent(len(points))
    return HarmonicMap.fit(points, field + read_by(suite, wrong_by), OPTIONS, POST, suite)


def independent(count: int) -> SuiteErrors:
    """Return errors of C and H, which move no reading, that no two sensors have in common."""
    suite = errors(count)
    sigma = np.where(np.arange(SIZE) < 3, 0.0, SIGMA) * (np.arange(SIZE) < SIZE - 1)
    still = np.concatenate([0 * suite.shift[:, :3], suite.shift[:, 3:]], axis=1)
    return replace(suite, covariance=np.diag(np.tile(sigma**2, 2)), shift=still)


def read_by(suite: SuiteErrors, wrong: FloatArray) -> FloatArray:
    """Return what errors add to readings, uT, shape (N, 3)."""
    count = len(suite.reading)
    return np.asarray(effect(suite, count, np.zeros((count, 3, 3))) @ wrong)


def test_a_survey_finds_stated_errors_of_its_sensors(
    found: HarmonicMap, wrong_by: FloatArray
) -> None:
    suite = found.learnt.suite
    assert suite is not None
    assert suite.found is not None
    sizes, turned = np.linalg.eigh(shown(2))
    turned = turned[:, sizes > 0.5]
    left = turned.T @ (wrong_by - suite.found.mean)
    P = turned.T @ suite.covariance @ turned
    # Nine differences of C and six of H: 99.9 % of chi-square lie below 37.7, 0.1 % below 3.5.
    assert 3.5 < left @ np.linalg.solve(P, left) < 37.7
    # What a sensor has in common with others is not found, and stays as it was stated.
    common = np.full(2, np.sqrt(0.5))[:, None, None] * np.eye(SIZE)[:, 3:12]
    common = common.reshape(2 * SIZE, 9)
    np.testing.assert_allclose(
        common.T @ suite.covariance @ common, common.T @ suite.found.stated @ common, atol=1e-15
    )


def test_later_readings_are_corrected_alike(found: HarmonicMap, wrong_by: FloatArray) -> None:
    points, field = readings()
    later = independent(len(points))
    wrong = field + read_by(later, wrong_by)
    one, both = found.learnt.suite, found.updated(points + 0.01, wrong, later).learnt.suite
    assert one is not None
    assert one.found is not None
    assert both is not None
    # Their errors are the same two sensors', not those of two more.
    np.testing.assert_array_equal(both.covariance, one.covariance)
    corrected = later.as_found_by(one).corrected(wrong)
    np.testing.assert_allclose(corrected, wrong - read_by(later, one.found.mean), atol=1e-12)
    strange = independent(len(points))
    strange = replace(strange, covariance=2 * strange.covariance)
    assert strange.as_found_by(one) is strange


def test_later_readings_that_nothing_is_stated_of_are_corrected_too(found: HarmonicMap) -> None:
    points, field = readings(50, seed=4)
    stated = independent(len(points))
    silent = replace(stated, covariance=0 * stated.covariance)
    one, other = (found.updated(points, field, each).learnt for each in (stated, silent))
    np.testing.assert_array_equal(other.readings.field, one.readings.field)
    assert one.suite is not None
    assert other.suite is not None
    np.testing.assert_array_equal(other.suite.covariance, one.suite.covariance)


def test_a_map_keeps_what_was_found(found: HarmonicMap) -> None:
    again = map_from_state(found.to_state())
    assert isinstance(again, HarmonicMap)
    one, other = found.learnt.suite, again.learnt.suite
    assert one is not None
    assert other is not None
    assert one.found is not None
    assert other.found is not None
    np.testing.assert_array_equal(other.found.mean, one.found.mean)
    np.testing.assert_array_equal(other.found.stated, one.found.stated)


def test_errors_that_a_survey_has_calibrated_are_not_found_twice(uncertain: HarmonicMap) -> None:
    assert uncertain.learnt.suite is not None
    assert uncertain.learnt.suite.found is None

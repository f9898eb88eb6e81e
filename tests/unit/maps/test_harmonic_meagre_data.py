"""What a harmonic map makes of meagre and strange surveys: it is not sure where it has no data."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from tests.worlds.exact import DipoleWorld
from tests.worlds.harmonic import (
    NO_SEARCH,
    OPTIONS,
    WORLD,
    assert_same,
    queries,
    readings,
    rms,
    within_survey,
)

pytestmark = pytest.mark.usefixtures("affordable")


def scores(ours: HarmonicMap, world: DipoleWorld, at: FloatArray) -> FloatArray:
    """Return errors over sigmas at points inside the map, shape (K, 3)."""
    sample = ours.query(at)
    inside = sample.inside
    truth, _ = world.field_and_gradient(at[inside])
    return np.asarray((sample.field[inside] - truth) / np.sqrt(sample.variance[inside]))


def test_a_survey_on_one_line_is_not_sure_beside_it() -> None:
    """Everything learnt, at most what 400 readings on eight metres can tell."""
    x = np.linspace(-4, 4, 400)
    points = np.column_stack([x, np.zeros(400), np.full(400, 0.4)])
    rng = np.random.default_rng(3)
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
    at = points[::4].repeat(3, axis=0)
    aside = rng.uniform(0.1, 0.45, len(at)) * np.exp(1j * rng.uniform(0, 2 * np.pi, len(at)))
    beside = at + np.column_stack([np.zeros(len(at)), aside.real, aside.imag])
    assert ours.variance(beside).sum() > 4 * ours.variance(at).sum()
    z = scores(ours, WORLD, beside)
    # One draw of a strongly correlated error; a sure map would be at ten.
    assert len(z) == 0 or rms(z) < 3


def test_a_vertical_line_is_not_sure_beside_it() -> None:
    z = np.linspace(0.2, 1.8, 200)
    points = np.column_stack([np.zeros(200), np.zeros(200), z])
    rng = np.random.default_rng(4)
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
    beside = points + np.array([0.3, 0.2, 0])
    assert ours.variance(beside).sum() > ours.variance(points).sum()
    assert rms(scores(ours, WORLD, beside)) < 3


def test_readings_at_one_point_that_disagree_are_averaged() -> None:
    points, field = readings()
    offset = np.array([5.0, -5.0, 3.0])
    twice = np.vstack([points, points[:1], points[:1]])
    one = HarmonicMap.fit(
        twice, np.vstack([field, field[:1] + offset, field[:1] - offset]), OPTIONS
    )
    other = HarmonicMap.fit(twice, np.vstack([field, field[:1], field[:1]]), OPTIONS)
    assert_same(one.query(queries()), other.query(queries()), 1e-8)


def test_places_that_disagree_make_no_sure_map() -> None:
    """Ten pairs of readings two centimetres apart and 5 uT apart, none of them merged."""
    along, across = np.repeat(0.1 * np.arange(10), 2), np.tile([0.0, 0.02], 10)
    points = np.column_stack([along, across, np.full(20, 0.4)])
    field = np.tile([20.0, 0.0, -40.0], (20, 1))
    field[::2] += 5
    ours = HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH, merge=0.01))
    assert len(ours.learnt.readings) == 20
    # The mean of readings that are 2.5 uT off it is the best there is.
    assert np.sqrt(ours.variance(points)).min() > 2.5 / np.sqrt(20)


def test_two_places_that_disagree_make_no_map() -> None:
    """Twenty readings within two centimetres, 5 uT apart."""
    points = np.repeat([[0.0, 0.0, 0.4], [0.02, 0.0, 0.4]], 10, axis=0)
    field = np.tile([20.0, 0.0, -40.0], (20, 1))
    field[10:] += 5
    with pytest.raises(MapError, match="readings fill 1 cubes of") as caught:
        HarmonicMap.fit(points, field, HarmonicOptions(search=NO_SEARCH))
    assert "\n" not in str(caught.value)


def test_between_two_surveys_the_map_knows_nothing() -> None:
    """Thirty metres apart, many tiles of none."""
    points, field = readings()
    away = np.array([30.0, 0, 0])
    far = WORLD.field_and_gradient(points + away)[0]
    ours = HarmonicMap.fit(np.vstack([points, points + away]), np.vstack([field, far]), OPTIONS)
    gap = np.column_stack([np.linspace(2.2, 27.8, 60), np.zeros(60), np.full(60, 0.5)])
    assert not ours.query(gap).inside.any()
    assert np.isfinite(ours.field_and_gradient(gap)[0]).all()
    assert ours.query(within_survey()).inside.all()
    assert ours.query(within_survey() + away).inside.all()
    # The waves of a box come again beyond it; what is known of them must not.
    known = ours.variance(within_survey()).sum(axis=1)
    assert ours.variance(gap).sum(axis=1).min() > 10 * np.median(known)


def test_a_long_reach_does_not_make_a_map_sure_of_the_unknown() -> None:
    options = OPTIONS.model_copy(update={"reach": 4.0})
    ours = HarmonicMap.fit(*readings(), options)
    beyond = np.column_stack([np.linspace(2.5, 5.0, 60), np.zeros(60), np.full(60, 0.5)])
    # All of it within four metres of a reading, none within one.
    known = ours.query(beyond).inside
    truth, _ = WORLD.field_and_gradient(beyond[known])
    error = ours.field_and_gradient(beyond[known])[0] - truth
    assert (np.abs(error) < 5 * np.sqrt(ours.variance(beyond[known]))).all()


def cage(seed: int) -> DipoleWorld:
    """Steel all around a drive that sees 300 uT of it."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([-2.5, -2.2, -0.5], [2.5, 2.2, 2.0], (400, 3))
    around = (np.abs(places[:, 0]) > 2) | (np.abs(places[:, 1]) > 1.7)
    around |= (places[:, 2] < -0.2) | (places[:, 2] > 1.4)
    places = places[around]
    return DipoleWorld(WORLD.uniform, places, rng.normal(0, 120, places.shape))


def test_readings_in_a_metal_cage_are_told_with_their_sigma() -> None:
    world, (points, _) = cage(5), readings()
    rng = np.random.default_rng(5)
    field = world.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    assert rms(field - field.mean(axis=0)) > 30
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 200}, "search": {"rounds": 0}, "modes": 300}
    )
    ours = HarmonicMap.fit(points, field, options)
    assert rms(scores(ours, world, within_survey())) < 2


def test_pure_noise_of_300_ut_is_known_nowhere() -> None:
    points, _ = readings()
    noise = np.random.default_rng(6).normal(0, 300, points.shape)
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 200}, "search": {"rounds": 0}, "modes": 300}
    )
    ours = HarmonicMap.fit(points, noise, options)
    # A mean of 600 readings of 300 uT is the best there is; a map of any slope knows less.
    assert np.sqrt(ours.variance(within_survey())).min() > 300 / np.sqrt(600) / 2


def test_a_uniform_field_is_known_inside() -> None:
    """Nothing but the Earth's field: no scale to learn, yet a map to calibrate C and H with."""
    points, _ = readings()
    rng = np.random.default_rng(7)
    field = np.array([22.0, 3, -38]) + rng.normal(0, 0.2, points.shape)
    options = HarmonicOptions.model_validate(
        {"learning": {"windows": 1, "modes": 100}, "search": {"rounds": 0}, "modes": 200}
    )
    sample = HarmonicMap.fit(points, field, options).query(within_survey())
    assert sample.inside.all()
    error = sample.field - [22.0, 3, -38]
    assert rms(error) < 0.05
    assert rms(error / np.sqrt(sample.variance)) < 3  # one draw, correlated over all places

"""The harmonic map as a whole: its statistics, its queries, its updates."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from l2m_factors.field_map import DifferentiableMap
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.sliding_gp import SlidingGP
from tests.worlds.harmonic import (
    NO_SEARCH,
    OPTIONS,
    PRIOR,
    WORLD,
    assert_same,
    queries,
    readings,
    rms,
    within_survey,
)

pytestmark = pytest.mark.usefixtures("affordable")


def test_a_survey_of_dipoles_is_predicted_with_a_true_sigma() -> None:
    """Everything by default, in a world that is not made of the map's features."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -3, 0.2], [3, 3, 0.8], (2250, 3))
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field)
    at = rng.uniform([-2.5, -2.5, 0.2], [2.5, 2.5, 0.8], (1000, 3))
    sample, (truth, slope) = ours.query(at), WORLD.field_and_gradient(at)
    error = sample.field - truth
    theirs = SlidingGP.fit(points, field).query(at).field - truth
    assert sample.inside.all()
    # 0.040 against 0.091 uT on a survey of eight metres; three heights at random help the
    # independent axes.
    assert rms(error) < 0.55 * rms(theirs)
    assert rms(sample.gradient - slope) < 0.3 * rms(slope)
    # Some 170 independent scores.
    assert 0.8 < rms(error / np.sqrt(sample.variance)) < 1.2
    assert ours.learnt.hyperparameters.noise == pytest.approx(0.2, rel=0.1)
    assert ours.learnt.origin.learning.at_bound == ()


def test_query_extends_smoothly_and_says_where_it_knows_nothing(harmonic: HarmonicMap) -> None:
    sample = harmonic.query(queries())
    field, gradient = harmonic.field_and_gradient(queries())
    inside = sample.inside
    assert 0 < inside.sum() < len(inside)
    np.testing.assert_array_equal(sample.field[inside], field[inside])
    np.testing.assert_array_equal(sample.gradient[inside], gradient[inside])
    # Other places at once: products of matrices round otherwise.
    variance = harmonic.variance(queries())[inside]
    np.testing.assert_allclose(sample.variance[inside], variance, rtol=1e-12)
    assert np.isnan(sample.field[~inside]).all()
    assert np.isnan(sample.gradient[~inside]).all()
    assert np.isinf(sample.variance[~inside]).all()
    assert np.isfinite(field).all()


def test_inside_ends_at_the_reach(harmonic: HarmonicMap) -> None:
    kept = harmonic.learnt.readings.points
    away = np.linalg.norm(queries()[:, None] - kept, axis=-1).min(axis=1)
    assert not harmonic.query(queries()).inside[away > OPTIONS.reach].any()
    assert harmonic.query(within_survey()).inside.all()


def test_the_order_of_queries_does_not_matter(harmonic: HarmonicMap) -> None:
    order = np.random.default_rng(6).permutation(300)
    one, other = harmonic.query(queries()[order]), harmonic.query(queries())
    # BLAS adds in another order where batches differ: rounding only.
    np.testing.assert_allclose(one.field, other.field[order], rtol=0, atol=1e-10)
    np.testing.assert_allclose(one.variance, other.variance[order], rtol=1e-10)


@settings(max_examples=40)
@given(st.lists(st.tuples(*[st.floats(-1e3, 1e3, allow_nan=False)] * 3), min_size=1, max_size=10))
def test_a_trial_step_to_anywhere_is_finite(
    harmonic: HarmonicMap, anywhere: list[tuple[float, float, float]]
) -> None:
    """A kilometre up, down or away; and a metre from all readings never surer than inside."""
    points = np.array(anywhere)
    field, gradient = harmonic.field_and_gradient(points)
    variance = harmonic.variance(points)
    assert np.isfinite(field).all()
    assert np.isfinite(gradient).all()
    assert np.isfinite(variance).all()
    away, _ = cKDTree(harmonic.learnt.readings.points).query(points)
    known = harmonic.variance(within_survey()).sum(axis=1)
    assert (variance[away > 1].sum(axis=1) > known.max()).all()


@pytest.mark.parametrize("towards", [[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
def test_beyond_the_survey_the_map_knows_less_and_less(
    harmonic: HarmonicMap, towards: list[float]
) -> None:
    """From the middle outwards: at three metres no better than the field varies."""
    steps = np.linspace(0, 4, 9)[:, None]
    variance = harmonic.variance(np.array([0.0, 0.0, 0.5]) + steps * towards).sum(axis=1)
    far = np.array([0.0, 0.0, 0.5]) + steps[6:] * towards
    assert variance[6:].min() > 50 * variance[0]
    assert not harmonic.query(far).inside.any()


def test_tiles_keep_to_their_number_of_modes() -> None:
    """Fine structure in a dense survey: what the modes cannot hold counts as variance."""
    fine = PRIOR.model_copy(update={"floor_depth": 0.15, "floor_scale": 5.0})
    points, field = readings(200)
    options = HarmonicOptions(hyperparameters=fine, search=NO_SEARCH, modes=100)
    ours = HarmonicMap.fit(0.4 * points, field, options)
    # "About how many": the modes along the axes come on top of the area's.
    assert max(len(tile.basis) for tile in ours.tiles) < 2 * options.modes


def test_a_summary_tells_what_went_in(harmonic: HarmonicMap) -> None:
    points, _ = readings()
    summary = harmonic.summary
    assert summary.kind == "harmonic"
    assert summary.readings == len(points)
    assert summary.rows == len(harmonic.learnt.readings)
    assert (summary.lower >= points.min(axis=0)).all()
    assert (summary.upper <= points.max(axis=0)).all()
    assert summary.facts["tiles"] == len(harmonic.tiles)
    for name, fact in summary.facts.items():  # plain values, as promised
        assert type(fact) in (str, int, float, bool), name


def test_maps_satisfy_all_protocols(harmonic: HarmonicMap) -> None:
    """Mostly a statement to the type checker."""
    application: FieldMap = harmonic
    plugin: DifferentiableMap = harmonic
    assert isinstance(harmonic, UncertainMap)
    assert plugin.field_and_gradient(queries(7))[1].shape == (7, 3, 3)
    assert application.kind == "harmonic"


def assert_conditioned_on_all(ours: HarmonicMap) -> None:
    """Every tile is the posterior for the readings that are its members now."""
    whole = HarmonicMap.condition(ours.learnt, ours.options)
    # Equal numbers but for the order of sums, of which 1e6 remain in the condition.
    assert_same(ours.query(queries()), whole.query(queries()), 1e-8)
    for one, other in zip(ours.tiles, whole.tiles, strict=True):
        assert len(one.basis) == len(other.basis)


def test_an_updated_map_is_conditioned_on_all_readings(harmonic: HarmonicMap) -> None:
    ours = harmonic.updated(*readings(400, seed=9, east=2.0))
    assert ours.learnt.hyperparameters == harmonic.learnt.hyperparameters
    assert len(ours.tiles) > len(harmonic.tiles)
    assert_conditioned_on_all(ours)
    assert ours.summary.readings == 1000


def test_updates_in_parts_are_one_update(harmonic: HarmonicMap) -> None:
    points, field = readings(400, seed=9)
    parts = harmonic
    for rows in (slice(0, 150), slice(150, None)):
        parts = parts.updated(points[rows], field[rows])
    # Means of means.
    assert_same(parts.query(queries()), harmonic.updated(points, field).query(queries()), 1e-8)


def test_new_readings_in_a_corner_leave_the_other_tiles_alone(harmonic: HarmonicMap) -> None:
    points, field = readings(100, seed=9)
    ours = harmonic.updated(points * 0.1 + [1.4, 1.1, 0.4], field)
    kept = sum(any(new is old for old in harmonic.tiles) for new in ours.tiles)
    assert 0 < kept < len(ours.tiles)
    assert_conditioned_on_all(ours)

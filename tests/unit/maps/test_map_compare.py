from dataclasses import dataclass

import numpy as np
import pytest
from pydantic import ValidationError
from rich.console import Console

from l2m_gtsam.cli.tables.maps import comparison_table
from l2m_gtsam.data import FieldSample, FloatArray, MapState
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.build import KINDS, MapOptions, build_map
from l2m_gtsam.maps.compare import (
    LEAST_NOISE,
    CompareOptions,
    KindFigures,
    MapComparison,
    Prediction,
    compare_maps,
    evenly,
    figures_of,
    noise_of,
    standard_error,
)
from l2m_gtsam.maps.field_map import FieldMap, MapSummary, masked
from l2m_gtsam.maps.folds import fitting_fold, folds_of, patches_of
from l2m_gtsam.maps.training import training_set
from tests.worlds.exact import dipole_world

NOISE = 0.2
MEAN = np.array([20.0, 0.0, -40.0])


@dataclass(frozen=True)
class Flat:
    """A map of one value and one variance that answers where x is below a limit."""

    value: FloatArray
    sigma: float
    below: float = np.inf
    kind: str = "flat"

    @property
    def summary(self) -> MapSummary:
        return MapSummary(self.kind, 0, 0, np.zeros(3), np.zeros(3), {})

    def query(self, points: FloatArray) -> FieldSample:
        field, gradient = self.field_and_gradient(points)
        return masked(
            FieldSample(field, gradient, self.variance(points), points[:, 0] < self.below)
        )

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        return np.tile(self.value, (len(points), 1)), np.zeros((len(points), 3, 3))

    def variance(self, points: FloatArray) -> FloatArray:
        return np.full((len(points), 3), self.sigma**2)

    def updated(self, points: FloatArray, field: FloatArray, /) -> "Flat":
        return self

    def to_state(self) -> MapState:
        return MapState(self.kind, {}, {}, {})


def places(count: int = 4000) -> FloatArray:
    return np.random.default_rng(1).uniform([-4, -4, 0.3], [4, 4, 0.5], (count, 3))


def noisy(count: int = 4000) -> FloatArray:
    """Readings of a uniform field."""
    return MEAN + np.random.default_rng(2).normal(0, NOISE, (count, 3))


def figures(comparison: MapComparison, kind: str) -> KindFigures:
    found = next(result.figures for result in comparison.kinds if result.kind == kind)
    assert found is not None
    return found


def built(points: FloatArray, field: FloatArray, kind: str) -> FieldMap:
    return build_map(points, field, MapOptions(kind=kind))


@pytest.fixture(scope="module")
def dipoles() -> MapComparison:
    points = places()
    field, _ = dipole_world(1).field_and_gradient(points)
    noise = np.random.default_rng(3).normal(0, NOISE, field.shape)
    return compare_maps(
        points, field + noise, CompareOptions(kinds=("sliding_gp", "bilinear")), built
    )


def test_the_sliding_process_is_preferred_to_the_grid(dipoles: MapComparison) -> None:
    process, grid = figures(dipoles, "sliding_gp"), figures(dipoles, "bilinear")
    assert dipoles.recommended == "sliding_gp"
    assert process.log_likelihood > grid.log_likelihood
    assert process.rmse_shared < grid.rmse_shared
    # One is honest to a quarter, the other does not know where it has no data.
    assert 0.75 < process.z_std < 1.33 < grid.z_std
    assert process.noise == pytest.approx(NOISE, rel=0.3)
    assert "above bilinear" in dipoles.reason
    assert "may be as good" not in dipoles.reason


def test_folds_are_disjoint_in_space_and_hold_out_every_reading_once() -> None:
    options = CompareOptions(fold=1.0, folds=5)
    points = places()
    folds = folds_of(patches_of(points, 1.0), options)
    corner = points[:, :2].min(axis=0)
    squares = [tuple(square) for square in ((points[:, :2] - corner) // 1.0).tolist()]
    for fold in folds:
        seen = {squares[row] for row in (*fold.training, *fold.aside)}
        unseen = {squares[row] for row in fold.held_out}
        assert not seen & unseen
        assert len(unseen) == pytest.approx(len(set(squares)) / options.folds, abs=1)
        rows = np.concatenate([fold.training, fold.aside, fold.held_out])
        assert sorted(rows) == list(range(len(points)))
    held_out = np.concatenate([fold.held_out for fold in folds])
    assert sorted(held_out) == list(range(len(points)))


def test_the_same_seed_deals_the_same_folds() -> None:
    patch = patches_of(places(), 1.5)
    one, again = (folds_of(patch, CompareOptions(seed=4)) for _ in range(2))
    other = folds_of(patch, CompareOptions(seed=5))
    assert [fold.held_out.tolist() for fold in one] == [fold.held_out.tolist() for fold in again]
    assert [fold.held_out.tolist() for fold in one] != [fold.held_out.tolist() for fold in other]


def test_figures_of_three_readings_computed_by_hand() -> None:
    prediction = Prediction(
        error=np.array([[0.0, 1.0, -2.0], [4.0, 0.0, 2.0], [30.0, 30.0, 30.0]]),
        variance=np.array([[1.0, 1.0, 4.0], [4.0, 1.0, 1.0], [900.0, 900.0, 900.0]]),
        inside=np.array([True, True, False]),
        noise=np.array([0.3, 0.4]),
        seconds=np.array([1.0, 2.0]),
    )
    found = figures_of(prediction, np.array([True, False, False]))
    # z inside: 0, 1, -1; 2, 0, 2, of which two lie beyond 1.96.
    assert found.z_std == pytest.approx(np.sqrt(10 / 6))
    assert found.coverage == pytest.approx(4 / 6)
    assert found.inside == pytest.approx(2 / 3)
    np.testing.assert_allclose(found.rmse_axes, np.sqrt([8, 0.5, 4]))
    assert found.rmse == pytest.approx(np.sqrt(25 / 6))
    assert found.rmse_shared == pytest.approx(np.sqrt(5 / 3))
    # The squares of z: 2, 8, 3; the products of the variances: 4, 4, 900^3.
    squares, products = 2 + 8 + 3, np.log(4.0) + np.log(4.0) + 3 * np.log(900.0)
    expected = -0.5 * (squares + products) / 3 - 1.5 * np.log(2 * np.pi)
    assert found.log_likelihood == pytest.approx(expected)
    assert found.noise == pytest.approx(np.sqrt(0.125))
    assert found.seconds == 1.5


def test_no_reading_inside_of_all_maps_leaves_no_shared_error() -> None:
    one = np.ones((2, 3))
    prediction = Prediction(one, one, np.array([True, False]), np.ones(1), np.ones(1))
    assert np.isnan(figures_of(prediction, np.zeros(2, dtype=np.bool_)).rmse_shared)


@pytest.mark.parametrize("sigma", [0.0, 0.15, 0.5])
def test_the_noise_is_what_the_variance_of_the_map_leaves_unexplained(sigma: float) -> None:
    readings = training_set(places(), noisy())
    left = np.mean((readings.field - MEAN) ** 2) - sigma**2  # most likely, in closed form
    expected = max(np.sqrt(max(left, 0)), LEAST_NOISE)
    # The search ends within 1e-5 in the logarithm, at a bound a little wider.
    assert noise_of(Flat(MEAN, sigma), readings) == pytest.approx(expected, rel=1e-2)


def test_a_map_that_answers_nowhere_tells_no_noise() -> None:
    readings = training_set(places(), noisy())
    assert noise_of(Flat(MEAN, 1.0, below=-10), readings) == LEAST_NOISE


@pytest.mark.parametrize(("sigma", "z_std", "coverage"), [(0.0, 1.0, 0.95), (0.4, 0.5, 0.9999)])
def test_honest_and_cautious_maps_are_told_apart(
    sigma: float, z_std: float, coverage: float
) -> None:
    comparison = compare_maps(
        places(), noisy(), CompareOptions(kinds=("bilinear",)), lambda p, b, k: Flat(MEAN, sigma)
    )
    found = figures(comparison, "bilinear")
    # 12,000 values: the standard deviation is known to 0.7 %, the noise of each fold to 2 %.
    assert found.z_std == pytest.approx(z_std, rel=0.03)
    # Four times sqrt(0.95 * 0.05 / 12,000).
    assert found.coverage == pytest.approx(coverage, abs=0.008)
    assert found.rmse == pytest.approx(NOISE, rel=0.03)
    assert found.inside == 1


def test_an_over_confident_map_is_seen() -> None:
    """Its noise is fitted where it is good and judged where it is not."""

    def build(points: FloatArray, field: FloatArray, kind: str) -> FieldMap:
        return Flat(MEAN, 0.0)

    points = places()
    # A field of its own in one patch, a sixteenth of the area; what the maps say is never right.
    odd = (points[:, 0] > 2) & (points[:, 1] > 2)
    field = noisy() + 2.0 * odd[:, None]
    options = CompareOptions(kinds=("bilinear",), fold=2.0)
    found = figures(compare_maps(points, field, options, build), "bilinear")
    assert found.z_std > 1.5
    assert found.coverage < 0.96 - 1 / 32


def test_readings_outside_of_a_map_count_as_without_a_map() -> None:
    points, field = places(), noisy() + 3 * places()
    options = CompareOptions(kinds=("bilinear",), fold=2.0)
    comparison = compare_maps(points, field, options, lambda p, b, k: Flat(MEAN, 0.5, below=-1))
    found = figures(comparison, "bilinear")
    inside = points[:, 0] < -1
    assert found.inside == pytest.approx(inside.mean())
    np.testing.assert_allclose(
        found.rmse_axes, np.sqrt(np.mean((field - MEAN)[inside] ** 2, axis=0))
    )
    patch = patches_of(points, 2.0)
    folds = folds_of(patch, options)
    scores = []
    for fold in folds:
        known, rows = field[fold.training], fold.held_out
        n = noise_of(Flat(MEAN, 0.5, below=-1), training_set(points, field)[fold.aside])
        spread = np.where(inside[rows, None], 0.25 + n**2, known.var(axis=0))
        error = field[rows] - np.where(inside[rows, None], MEAN, known.mean(axis=0))
        density = np.exp(-(error**2) / (2 * spread)) / np.sqrt(2 * np.pi * spread)
        scores.append(np.log(density).sum(axis=1))
    # The same sums in another order.
    assert found.log_likelihood == pytest.approx(np.concatenate(scores).mean(), rel=1e-9)


def test_a_kind_that_fails_is_an_entry_with_its_reason() -> None:
    def build(points: FloatArray, field: FloatArray, kind: str) -> FieldMap:
        if kind == "sliding_gp":
            raise MapError("no such luck")
        return Flat(MEAN, 0.0)

    options = CompareOptions(kinds=("sliding_gp", "bilinear"))
    comparison = compare_maps(places(), noisy(), options, build)
    failed, works = comparison.kinds
    assert (failed.figures, failed.reason) == (None, "no such luck")
    assert (works.figures is not None, works.reason) == (True, "")
    assert comparison.recommended == "bilinear"
    assert comparison.reason == "bilinear is the only kind that works on these readings"


def test_no_kind_that_works_is_no_recommendation() -> None:
    options = CompareOptions(kinds=("bilinear",))
    outside = compare_maps(places(), noisy(), options, lambda p, b, k: Flat(MEAN, 0.0, below=-10))
    assert outside.recommended is None
    assert "no held-out reading lies inside" in outside.kinds[0].reason
    assert outside.reason == "no kind of map works on these readings"
    assert outside.reason in rendered(outside)


def test_a_difference_within_its_error_is_called_so() -> None:
    options = CompareOptions(kinds=("sliding_gp", "bilinear"))
    tied = compare_maps(places(), noisy(), options, lambda p, b, k: Flat(MEAN, 0.0))
    assert tied.recommended == "sliding_gp"
    assert tied.reason.endswith("over the patches: bilinear may be as good")


def test_the_standard_error_is_that_of_independent_patches() -> None:
    """Against a thousand draws of patches whose readings share their value."""
    rng = np.random.default_rng(9)
    patch = np.repeat(np.arange(200), 7)
    draws = rng.normal(size=(1000, 200))[:, patch]
    stated = [standard_error(draw, patch) for draw in draws]
    # 1000 draws know a standard deviation to 2.2 %, which is more than the 0.2 % of their mean.
    assert np.mean(stated) == pytest.approx(draws.mean(axis=1).std(), rel=0.07)
    one_each = rng.normal(size=50)
    expected = one_each.std(ddof=1) / np.sqrt(50)
    assert standard_error(one_each, np.arange(50)) == pytest.approx(expected)


def test_at_most_so_many_readings_are_used() -> None:
    comparison = compare_maps(
        places(),
        noisy(),
        CompareOptions(kinds=("bilinear",), most=500),
        lambda p, b, k: Flat(MEAN, 0.0),
    )
    assert comparison.readings == 500
    kept = evenly(training_set(places(), noisy()), 400).points
    np.testing.assert_array_equal(kept[[0, -1]], places()[[0, -1]])
    # Ten apart: all of them lie in the list, in order.
    rows = [np.flatnonzero((places() == point).all(axis=1))[0] for point in kept]
    assert set(np.diff(rows)) == {10, 11} or set(np.diff(rows)) == {10}


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((8, 8), 1.5),  # 36 patches, more than four for each of four folds
        ((2.4, 2.3), 1.5 * 0.8**4),  # 0.61 m, the first edge that gives 4 x 4
        ((30, 0.2), 1.5),  # a corridor counts by its length
        ((0.3, 0.2), 1.5 * 0.8**12),  # the last edge above a decimetre
    ],
)
def test_patches_suit_the_area(size: tuple[float, float], expected: float) -> None:
    points = np.random.default_rng(1).uniform([0, 0, 0], [*size, 0.5], (4000, 3))
    assert fitting_fold(points, CompareOptions()) == pytest.approx(expected)
    assert fitting_fold(points, CompareOptions(fold=0.7)) == 0.7


def test_too_few_patches_are_refused_in_one_line() -> None:
    with pytest.raises(MapError, match=r"fill 1 patches, .* a smaller fold is needed"):
        compare_maps(places(), noisy(), CompareOptions(fold=20), built)


def test_bad_readings_are_refused() -> None:
    spoiled = noisy()
    spoiled[7, 1] = np.nan
    with pytest.raises(MapError, match="training reading 7 of 4000 is not finite"):
        compare_maps(places(), spoiled, CompareOptions(), built)


def test_unknown_kinds_are_refused_and_the_slow_reference_is_left_out() -> None:
    with pytest.raises(ValidationError, match="'spline' is not known"):
        CompareOptions(kinds=("spline",))
    assert set(CompareOptions().kinds) == set(KINDS) - {"dense_gp"}


def rendered(comparison: MapComparison) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        console.print(comparison_table(comparison))
    return capture.get()


def test_the_table_shows_figures_and_reasons(dipoles: MapComparison) -> None:
    text = rendered(dipoles)
    assert "4,000 readings in 36 patches of 1.5 m" in text
    assert "recommended: sliding_gp" in text
    assert "failed" not in text
    assert f"{figures(dipoles, 'bilinear').rmse:.3f}" in text

    def broken(points: FloatArray, field: FloatArray, kind: str) -> FieldMap:
        raise MapError("[bold]a reason[/bold]")

    options = CompareOptions(kinds=("bilinear",))
    assert "[bold]a reason[/bold]" in rendered(compare_maps(places(), noisy(), options, broken))

"""Which model is recommended: the rule on numbers made by hand, and truth on simulated drives."""

from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from rich.console import Console
from scipy.signal import lfilter

from l2m_gtsam.cli.tables.calibration import model_table
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.sensor_models import Coefficients, Model, Samples
from l2m_gtsam.solve.model_comparison import (
    HeldOut,
    ModelOptions,
    Trial,
    choose,
    compare_models,
    correlation_of,
    predicted,
    reason_of,
    segments_of,
)
from l2m_gtsam.solve.model_fits import Fit, Solution, Spread, compress, fit_model
from l2m_gtsam.text import with_sigma
from tests.drives.model import NOISE, Setting, drawn

NOTHING = Coefficients(np.zeros((3, 3)), np.zeros(3), np.zeros((0, 3)), np.zeros((3, 3)))
OPTIONS = ModelOptions()


def trial(
    model: Model, parameters: int, scores: list[float], bic: float, counted: float = 1.0
) -> Trial:
    """A model with given marks; each of its parameters counts so often."""
    solution = Solution(np.zeros((7, 3)), np.zeros((parameters, 7, 3)))
    fit = Fit(solution, NOTHING, parameters, 1.0, 1.0)
    spread = Spread(NOTHING, counted * parameters)
    return Trial(model, fit, spread, 1.0, HeldOut(1.0, np.array(scores)), bic)


def test_the_simplest_within_one_standard_error_of_the_best() -> None:
    """FULL is 0.1 ahead of SCALE in the mean, by 0, 0.1 or 0.2: a standard error of 0.058."""
    best = trial(Model.FULL, 12, [1.1, 2.2, 3.0], 100)
    scale = trial(Model.SCALE, 9, [1.0, 2.0, 3.0], 101)
    offset = trial(Model.OFFSET, 6, [0.0, 1.0, 2.0], 102)
    behind, error = best.lead(scale)
    assert behind == pytest.approx(0.1)
    assert error == pytest.approx(0.1 / np.sqrt(3))
    choice = choose([offset, scale, best], 10)
    assert choice.chosen is choice.best is choice.least is best
    # Ahead by 0.29 in one segment and a little behind in another: 0.093, a standard error of 0.098.
    lucky = trial(Model.FULL, 12, [1.29, 1.99, 3.0], 100)
    choice = choose([offset, scale, lucky], 10)
    assert choice.chosen is scale
    assert choice.best is lucky


def test_a_bic_far_above_the_least_strikes_out() -> None:
    best = trial(Model.ALL, 21, [2.0, 2.1, 2.0], 111)
    small = trial(Model.OFFSET, 6, [1.0, 1.1, 1.2], 100)
    assert choose([small, best], 10).chosen is small
    assert choose([small, best], 12).chosen is best
    # Where the parameters between them count three times, 111 is 11 / 3 above 100.
    often = replace(best, spread=Spread(NOTHING, 6 + 3 * 15.0))
    assert often.above(small) == pytest.approx(11 / 3)
    assert choose([small, often], 10).chosen is often


def test_models_of_as_many_parameters_are_compared_by_how_often_all_count() -> None:
    regressors = trial(Model.REGRESSORS, 21, [1.0, 1.0], 140, counted=4.0)
    eddy = trial(Model.EDDY, 21, [1.0, 1.0], 100, counted=4.0)
    assert regressors.above(eddy) == pytest.approx(10)
    assert eddy.above(eddy) == 0


def test_the_reason_names_the_next_simpler_model() -> None:
    full, scale = trial(Model.FULL, 12, [2.0, 2.2], 100), trial(Model.SCALE, 9, [1.0, 1.0], 345)
    reason = reason_of(choose([scale, full], 10), [scale, full])
    assert reason == (
        "full predicts held-out segments best; scale is 1.1 per reading behind, with a standard "
        "error of 0.1, its BIC 245 above the least"
    )
    alone = reason_of(choose([scale], 10), [scale])
    assert alone == "scale predicts held-out segments best"


@pytest.mark.parametrize("model", list(Model))
@pytest.mark.parametrize("map_error", [0.0, NOISE])
def test_the_truth_is_recommended(model: Model, map_error: float) -> None:
    """Each effect is 1 to 2 uT under 0.2 or 0.28 uT; `make study` takes 100 drives each."""
    setting = Setting(map_error=map_error)
    found = [compare_models(drawn(model, seed, setting).samples, OPTIONS) for seed in range(10)]
    assert sum(each.recommended is model for each in found) >= 9


def test_counting_correlated_readings_as_independent_finds_what_is_not_there() -> None:
    """The map's errors last for 40 readings; a rotation and an offset is all there is."""
    setting = Setting(map_error=0.4, length=40.0)
    naive, ours = 0, 0
    for seed in range(20):
        samples = drawn(Model.OFFSET, seed, setting).samples
        packed, values = compress(samples), samples.z.size
        fits = [fit_model(model, packed) for model in Model]
        bic = [values * np.log(f.squares / values) + f.parameters * np.log(values) for f in fits]
        naive += int(np.argmin(bic)) > 0
        ours += compare_models(samples, OPTIONS).recommended is not Model.OFFSET
    assert naive >= 10
    assert ours <= 2


def test_held_out_segments_are_predicted_from_the_others() -> None:
    """Against numpy's least squares on each training set, without weights."""
    samples = drawn(Model.FULL, 1, Setting(readings=90)).samples
    held_out = predicted(samples, segments_of(samples, 3), [Model.FULL])[Model.FULL]
    X = np.column_stack([np.ones(90), samples.b])
    errors, means = [], []
    for k in range(3):
        out = np.arange(30 * k, 30 * k + 30)
        others = np.setdiff1d(np.arange(90), out)
        solution, left = np.linalg.lstsq(X[others], samples.z[others])[:2]
        variance = left.sum() / (3 * 60 - 12)
        e = samples.z[out] - X[out] @ solution
        density = np.exp(-(e**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        errors.append(e)
        means.append(np.mean(np.log(density).sum(axis=1)))
    assert held_out.rms == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=1e-9)
    np.testing.assert_allclose(held_out.scores, means, rtol=1e-9)


@pytest.mark.parametrize("fade", [0.0, 0.5, 0.95])
def test_the_correlation_of_residuals_is_found(fade: float) -> None:
    """20,000 values on three axes: standard errors near 0.004 times the root of 1 + 2 sum."""
    drops = np.random.default_rng(1).normal(size=(20_000, 3))
    found = correlation_of(lfilter([1.0], [1.0, -fade], drops, axis=0))
    assert found[0] == 1.0
    np.testing.assert_allclose(found[1:6], fade ** np.arange(1, 6), atol=0.03)
    assert (found >= 0).all()
    first = int(np.argmax(found == 0))
    assert not found[first:].any()
    # What is cut off and what noise adds is a few per cent of the sum.
    assert 2 * found.sum() - 1 == pytest.approx((1 + fade) / (1 - fade), rel=0.1)


def test_nothing_left_is_not_correlated() -> None:
    np.testing.assert_array_equal(correlation_of(np.zeros((4, 3))), [1, 0, 0, 0])


@pytest.mark.parametrize("model", list(Model))
def test_exact_readings_ask_for_no_more_than_the_truth(model: Model) -> None:
    case = drawn(model, 3, Setting(readings=120, noise=1e-13))
    exact = replace(case.samples, weights=np.ones(120))
    assert compare_models(exact, OPTIONS).recommended is model


@settings(max_examples=5)
@given(factor=st.floats(1e-3, 1e3))
def test_only_ratios_of_weights_matter(factor: float) -> None:
    samples = drawn(Model.SCALE, 2, Setting(readings=80)).samples
    other = replace(samples, weights=factor * samples.weights)
    one, two = (compare_models(each, OPTIONS) for each in (samples, other))
    assert one.recommended is two.recommended
    for a, b in zip(one.fits, two.fits, strict=True):
        assert b.held_out_score == pytest.approx(a.held_out_score, rel=1e-6)
        assert b.bic_above == pytest.approx(a.bic_above, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(two.sigma.C, one.sigma.C, rtol=1e-6)


def test_without_numbers_there_are_four_models() -> None:
    samples = drawn(Model.EDDY, 4).samples
    none = replace(samples, q=np.empty((len(samples), 0)), names=())
    comparison = compare_models(none, OPTIONS)
    assert [fit.model for fit in comparison.fits] == [
        *(Model.OFFSET, Model.SCALE, Model.FULL),
        Model.EDDY,
    ]
    assert comparison.recommended is Model.EDDY
    assert comparison.coefficients.h.shape == (0, 3)


def faulty(name: str) -> Samples:
    samples = drawn(Model.FULL, 0, Setting(readings=100)).samples
    holes = samples.q.copy()
    holes[3] = np.nan
    zero = samples.weights.copy()
    zero[5] = 0.0
    return {
        "number": replace(samples, q=holes),
        "reading": replace(samples, z=samples.z * [1, np.inf, 1]),
        "weight": replace(samples, weights=zero),
        "few": samples[np.arange(31)],
    }[name]


def test_without_rates_there_is_no_eddy_model() -> None:
    samples = drawn(Model.FULL, 4).samples
    parked = replace(samples, db_dt=np.zeros_like(samples.b))
    found = [fit.model for fit in compare_models(parked, OPTIONS).fits]
    assert found == [Model.OFFSET, Model.SCALE, Model.FULL, Model.REGRESSORS]


FAULTS = {
    "number": "models: regressor 'amp': some are not finite; leave these readings out",
    "reading": "models: readings: some are not finite; leave these readings out",
    "weight": "models: every reading needs a finite weight above 0",
    "few": "models: 31 readings cannot distinguish models of 7 columns in 8 segments, at least 32 "
    "are needed",
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_one_line(name: str) -> None:
    with pytest.raises(CalibrationError) as error:
        compare_models(faulty(name), OPTIONS)
    assert str(error.value) == FAULTS[name]


@pytest.mark.parametrize("wrong", [{"segments": 2}, {"strong": 0}, {"strong": np.nan}])
def test_options_that_make_no_sense_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        ModelOptions.model_validate(wrong)


def test_the_table_shows_every_model_and_the_recommended_one() -> None:
    comparison = compare_models(drawn(Model.REGRESSORS, 1).samples, OPTIONS)
    console = Console(width=160, record=True, file=StringIO())
    console.print(model_table("front[1]/mag", comparison))
    text = console.export_text()
    assert "Models of front[1]/mag, amp: 400 readings with the information of" in text
    for fit in comparison.fits:
        assert with_sigma(fit.held_out_score, fit.score_error) in text
    assert "recommended: full + regressors; full + regressors predicts" in " ".join(text.split())

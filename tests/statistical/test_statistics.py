"""The judges of sigmas are themselves judged: on draws whose distribution is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.studies.statistics import (
    chi_square_band,
    clustered_mean,
    ellipsoid_coverage,
    inside_interval,
    nees,
    wilson_interval,
)
from tests.worlds.studied_maps import z_scores

COUNT = 4000
# Probability that a true covariance fails a test here by chance, per seed: the seeds are fixed.
LEVEL = 0.999
# As of t in metres, C and H in microtesla: sigmas over four decades in one covariance.
SCALES = np.array([1e-3, 3e-3, 0.2, 1e-2, 5.0])


@pytest.fixture(scope="module")
def covariance() -> FloatArray:
    root = np.random.default_rng(1).normal(size=(5, 5)) * SCALES[:, None]
    return np.asarray(root @ root.T)


@pytest.fixture(scope="module")
def errors(covariance: FloatArray) -> FloatArray:
    rng = np.random.default_rng(2)
    root = np.linalg.cholesky(covariance)
    return np.asarray(rng.normal(size=(COUNT, 5)) @ root.T)


def judged(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    return nees(errors, np.broadcast_to(covariance, (len(errors), *covariance.shape)))


def test_nees_is_the_quadratic_form(errors: FloatArray, covariance: FloatArray) -> None:
    """Against the inverse, whose condition of 1e8 costs eight digits."""
    expected = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)
    np.testing.assert_allclose(judged(errors, covariance), expected, rtol=1e-6)


def test_true_covariances_are_within_the_bands(errors: FloatArray, covariance: FloatArray) -> None:
    values = judged(errors, covariance)
    assert values.mean() in chi_square_band(5, COUNT, LEVEL)
    share = ellipsoid_coverage(values, 5).mean()
    assert 0.95 in wilson_interval(share, COUNT, LEVEL)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_covariances_of_wrong_size_are_caught(
    errors: FloatArray, covariance: FloatArray, factor: float
) -> None:
    """A tenth of variance shifts the mean of 4,000 NEES by 0.5, seven of its standard errors."""
    values = judged(errors, factor * covariance)
    assert values.mean() not in chi_square_band(5, COUNT, LEVEL)
    assert 0.95 not in wilson_interval(ellipsoid_coverage(values, 5).mean(), COUNT)


def test_shifted_errors_are_caught(errors: FloatArray, covariance: FloatArray) -> None:
    values = judged(errors + 0.4 * np.sqrt(np.diag(covariance)), covariance)
    assert values.mean() not in chi_square_band(5, COUNT, LEVEL)


def test_neglected_correlation_is_caught(errors: FloatArray, covariance: FloatArray) -> None:
    values = judged(errors, np.diag(np.diag(covariance)))
    assert 0.95 not in wilson_interval(ellipsoid_coverage(values, 5).mean(), COUNT)


def test_z_scores_count_points_inside_alone() -> None:
    """Standard scores of exact draws; NaN and infinite variance outside never enter."""
    rng = np.random.default_rng(3)
    sigma, truth = rng.uniform(0.1, 2.0, (COUNT, 3)), rng.normal(0, 20, (COUNT, 3))
    inside = np.arange(COUNT) % 10 > 0
    field = np.where(inside[:, None], truth + sigma * rng.normal(size=(COUNT, 3)), np.nan)
    variance = np.where(inside[:, None], sigma**2, np.inf)
    sample = FieldSample(field, np.zeros((COUNT, 3, 3)), variance, inside)
    z = z_scores(sample, truth)
    assert z.shape == (inside.sum(), 3)
    assert 0.95 in wilson_interval(inside_interval(z).mean(), z.size, LEVEL)
    assert z.size * z.std() ** 2 == pytest.approx(z.size, abs=4 * np.sqrt(2 * z.size))
    # Sigmas a tenth too small are told from true ones by 10,800 scores.
    assert 0.95 not in wilson_interval(inside_interval(z / 0.9).mean(), z.size, LEVEL)


def shared_draws(seed: int, surveys: int, drives: int, share: float) -> FloatArray:
    """NEES of errors of which ``share`` of the variance is common to all drives of a survey."""
    rng = np.random.default_rng(seed)
    common = np.repeat(rng.normal(size=(surveys, 3)), drives, axis=0)
    own = rng.normal(size=(surveys * drives, 3))
    return np.asarray(np.sum((np.sqrt(share) * common + np.sqrt(1 - share) * own) ** 2, axis=1))


# The naive band passes a share 2 Phi(1.96 / sqrt(deff)) - 1, deff = 1 + 9 share^2: 95, 72, 48 %.
@pytest.mark.parametrize(("share", "naive_passes"), [(0.0, 0.95), (0.5, 0.72), (0.95, 0.48)])
def test_bands_hold_where_drives_share_a_survey(share: float, naive_passes: float) -> None:
    """True sigmas pass in about 95 of 100 studies of 20 surveys with 10 drives, however shared.

    Student's interval of 20 skewed means covers 91-95 %; four standard errors of a share of 300
    are 5-11 %. The band for independent drives fails far more often once errors are shared.
    """
    surveys, drives, studies = 20, 10, 300
    group = np.repeat(np.arange(surveys), drives)
    student, scaled, naive = 0, 0, 0
    for seed in range(studies):
        mean = clustered_mean(values := shared_draws(seed, surveys, drives, share), group)
        assert mean.mean == pytest.approx(values.mean())
        student += 3.0 in mean.band()
        scaled += mean.mean in chi_square_band(3, mean.effective)
        naive += mean.mean in chi_square_band(3, surveys * drives)
    assert student / studies > 0.86
    assert scaled / studies > 0.86
    assert naive / studies == pytest.approx(naive_passes, abs=0.11)


def test_effective_count_spans_groups_to_values() -> None:
    """2,000 groups of five: equal values count once, independent ones five times."""
    rng, group = np.random.default_rng(5), np.repeat(np.arange(2000), 5)
    equal = clustered_mean(np.repeat(rng.normal(size=2000), 5), group)
    alone = clustered_mean(rng.normal(size=10_000), group)
    assert equal.effective == pytest.approx(2000, rel=0.01)
    # The variance of 2,000 sums is known to sqrt(2 / 2000) = 3 %.
    assert alone.effective == pytest.approx(10_000, rel=0.1)
    assert alone.standard_error == pytest.approx(0.01, rel=0.1)


def test_one_survey_tells_nothing_of_surveys() -> None:
    with pytest.raises(ValueError, match="two or more"):
        clustered_mean(np.arange(5.0), np.zeros(5, dtype=np.int64))


@given(st.integers(1, 15), st.floats(2, 500))
def test_the_chi_square_band_narrows_around_its_dof(dof: int, count: float) -> None:
    band, wider = chi_square_band(dof, 2 * count), chi_square_band(dof, count)
    assert wider.low < band.low < dof < band.high < wider.high
    # Definition: 95 % of the chi-square of the sum lies within.
    inside = np.diff(chi2.cdf([band.low * 2 * count, band.high * 2 * count], dof * 2 * count))
    assert inside[0] == pytest.approx(0.95, abs=1e-6)


@given(st.integers(1, 400), st.data())
def test_wilson_interval_solves_its_equation(count: int, data: st.DataObject) -> None:
    """Both ends p satisfy (share - p)^2 = z^2 p (1 - p) / count."""
    share = data.draw(st.integers(0, count)) / count
    band = wilson_interval(share, count)
    for p in (band.low, band.high):
        assert (share - p) ** 2 == pytest.approx(1.959964**2 * p * (1 - p) / count, abs=1e-6)
    assert -1e-12 < band.low < band.high < 1 + 1e-12

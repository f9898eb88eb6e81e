"""The same numbers as those of ``scipy.stats``, at the edges, too."""

import numpy as np
import pytest
from scipy.stats import chi2, ncx2

from l2m_gtsam.solve.chi_square import (
    chance_beyond,
    density,
    exceeded_by,
    noticed_sigmas,
    quantile,
)

SHARES = np.array([0.0, 1e-9, 0.5, 0.95, 0.999, 1.0, np.nan])
VALUES = np.array([-5.0, -1e-12, 0.0, 0.3, 7.81, 80.0, 1e4, np.inf, np.nan])


@pytest.mark.parametrize("freedom", [0, 1, 2, 3, 15, 3000])
def test_quantiles_and_chances(freedom: int) -> None:
    np.testing.assert_allclose(quantile(SHARES, freedom), chi2.ppf(SHARES, freedom), rtol=1e-12)
    np.testing.assert_allclose(chance_beyond(VALUES, freedom), chi2.sf(VALUES, freedom), rtol=1e-12)
    np.testing.assert_allclose(exceeded_by(SHARES, freedom), chi2.isf(SHARES, freedom), rtol=1e-12)


def test_several_freedoms_at_once() -> None:
    freedom = np.array([1, 3, 0])
    np.testing.assert_allclose(quantile(0.5, freedom), chi2.ppf(0.5, freedom), rtol=1e-12)


@pytest.mark.parametrize("freedom", [2, 3, 15])
def test_densities(freedom: int) -> None:
    values = np.linspace(0, 40, 50)
    np.testing.assert_allclose(density(values, freedom), chi2.pdf(values, freedom), rtol=1e-12)


@pytest.mark.parametrize("freedom", [1, 3, 15])
def test_a_mean_that_is_noticed_is_missed_as_seldom_as_is_said(freedom: int) -> None:
    sigmas = noticed_sigmas(freedom, 1e-3, 0.01)
    assert ncx2.cdf(chi2.isf(1e-3, freedom), freedom, sigmas**2) == pytest.approx(0.01, rel=1e-6)

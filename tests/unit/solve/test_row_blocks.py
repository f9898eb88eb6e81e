"""Matrices in blocks of rows against the same matrices as a whole, and errors that come later."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.sparse import csr_array

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.marginal import ANYTHING_UT, MarginalRows
from l2m_gtsam.solve.linear_algebra import ROWS, RowBlocks
from tests.worlds.loop_rows import DIPOLE, loop_path, rows_with


def matrix(seed: int, rows: int) -> FloatArray:
    """Return a matrix whose columns are zero but for a third of the rows each."""
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((rows, 12))
    first = rng.integers(0, max(rows - rows // 3, 1), 12)
    row = np.arange(rows)[:, None]
    return np.where((row >= first) & (row < first + rows // 3 + 1), values, 0.0)


@pytest.mark.parametrize("sparse", [True, False])
@given(st.integers(0, 10_000), st.integers(1, 3 * ROWS))
def test_products_are_those_of_the_whole_matrix(sparse: bool, seed: int, rows: int) -> None:
    whole, rng = matrix(seed, rows), np.random.default_rng(seed + 1)
    found = RowBlocks.of(csr_array(whole) if sparse else whole)
    np.testing.assert_array_equal(found.toarray(), whole)
    x, y = rng.standard_normal((12, 2)), rng.standard_normal((rows, 2))
    # Sums in another order: rounding of some thousand terms.
    np.testing.assert_allclose(found @ x, whole @ x, atol=1e-11)
    np.testing.assert_allclose(found.transposed_times(y), whole.T @ y, atol=1e-11)
    np.testing.assert_allclose(found.transposed_times(csr_array(y)), whole.T @ y, atol=1e-11)
    np.testing.assert_allclose(found.gram(), whole.T @ whole, atol=1e-11)


@given(st.integers(0, 10_000), st.integers(2, 3 * ROWS))
def test_columns_are_added_and_rows_taken(seed: int, rows: int) -> None:
    whole, more = matrix(seed, rows), matrix(seed + 1, rows)
    some = np.flatnonzero(np.random.default_rng(seed).random(rows) < 0.4)
    found = RowBlocks.of(whole).beside(csr_array(more)).beside(more[:, :3])
    expected = np.hstack([whole, more, more[:, :3]])
    np.testing.assert_array_equal(found.toarray(), expected)
    if len(some):
        np.testing.assert_array_equal(found.at(some).toarray(), expected[some])


def test_errors_that_come_later_count_as_those_from_the_beginning() -> None:
    field, _ = DIPOLE.field_and_gradient(loop_path())
    rows, features = rows_with(field, 4), np.random.default_rng(5).standard_normal((240, 3, 2))
    wrong = [7, 130]
    columns = np.concatenate([3 * k + np.arange(3) for k in wrong])
    check_grown(rows.beside(features, 2.0), anew(rows, rows.whitened(features), 2.0))
    check_grown(rows.without(wrong), anew(rows, rows.whitening.toarray()[:, columns], ANYTHING_UT))


def anew(rows: MarginalRows, added: FloatArray, sigma: float) -> MarginalRows:
    """Return rows made with more errors, whose information is factored as a whole."""
    prior = block_diag(rows.prior, sigma**-2 * np.eye(added.shape[1]))
    return replace(rows, nuisance=rows.nuisance.beside(added), prior=prior)


def check_grown(found: MarginalRows, expected: MarginalRows) -> None:
    # A deviation of 1e4 uT beside noise of 0.1 leaves six of sixteen digits.
    own = DIPOLE.derivatives(found.points)
    information, squared = expected.information(own), expected.pull(expected.residual)[1]
    scale = np.sqrt(np.outer(np.diag(information), np.diag(information)))
    assert np.abs((found.information(own) - information) / scale).max() < 1e-5
    assert found.pull(found.residual)[1] == pytest.approx(squared, rel=1e-5)

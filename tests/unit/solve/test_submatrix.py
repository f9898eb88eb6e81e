"""Sums over and into rows and columns of a matrix, against NumPy's indexing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.solve.submatrix import add_upper, submatrix, upper_product


@given(n=st.integers(1, 12), share=st.floats(0, 1), seed=st.integers(0, 2**32 - 1))
def test_they_are_what_indexing_by_two_lists_gives(n: int, share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, at = rng.normal(size=(n, n)), rng.permutation(n)[: round(share * n)]
    half = rng.normal(size=(len(at), len(at)))
    block, both = half + half.T, np.ix_(at, at)
    np.testing.assert_array_equal(submatrix(matrix, at), matrix[both])
    upper = np.triu(matrix)[both]
    # Sums of at most 144 products, of either order: rounding.
    assert upper_product(matrix, at, block) == pytest.approx((upper * block).sum(), abs=1e-12)
    added, wanted = matrix.copy(), np.zeros((n, n))
    wanted[both] = block
    add_upper(added, at, block)
    np.testing.assert_array_equal(added, matrix + np.triu(wanted))

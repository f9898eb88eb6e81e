"""Roots of covariances: they multiply to the matrix they were taken of, singular ones too."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.solve.linear_algebra import (
    add_upper,
    correlation_factor,
    covariance_root,
    eigenpairs,
    information_root,
    inverse_of_factor,
    leading_eigenvectors,
    lower_information_root,
    right_divided,
    sound_information_root,
    submatrix,
    triangular_information_root,
    triangular_rows,
)


def test_a_root_has_the_covariance() -> None:
    rng = np.random.default_rng(0)
    half = rng.normal(size=(8, 5)) * 10.0 ** rng.uniform(-4, 2, (8, 1))
    covariance = half @ half.T
    sigma = np.sqrt(np.diag(covariance))
    root = covariance_root(covariance, sigma)
    np.testing.assert_allclose(
        root @ root.T / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-12
    )


def test_a_root_of_a_singular_covariance() -> None:
    rng = np.random.default_rng(4)
    A = rng.normal(size=(15, 6)) * np.logspace(-3, 1, 15)[:, None]
    A[3] = 0.0  # something exact
    P = A @ A.T
    L = covariance_root(P, np.sqrt(np.diag(P)))
    np.testing.assert_allclose(L @ L.T, P, atol=1e-9)


def test_roots_of_an_information_whiten() -> None:
    """Both kinds, of sigmas from 1e-4 to 10; the ridge is what the second is off by."""
    rng = np.random.default_rng(1)
    mixing, sigma = np.eye(6) + 0.2 * rng.normal(size=(6, 6)), 10.0 ** rng.uniform(-4, 1, 6)
    P = mixing @ mixing.T * np.outer(sigma, sigma)
    W = information_root(P, np.sqrt(np.diag(P)), 1e-9)
    np.testing.assert_allclose(W @ P @ W.T, np.eye(6), atol=1e-9)
    T = triangular_information_root(P, 1e-12)
    np.testing.assert_array_equal(T, np.tril(T))
    np.testing.assert_allclose(T @ P @ T.T, np.eye(6), atol=1e-9)


def test_a_direction_that_is_exact_keeps_the_least_variance() -> None:
    P = np.diag([4.0, 0.0])
    W = information_root(P, np.array([2.0, 1e-3]), 1e-4)
    np.testing.assert_allclose(W.T @ W, np.diag([0.25, 1e10]), rtol=1e-12)


def test_an_exact_direction_has_no_row_of_a_sound_root() -> None:
    sigma = np.array([1e-3, 1e-3, 10.0])
    S = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) * np.outer(sigma, sigma)
    W = sound_information_root(S)
    assert W.shape == (2, 3)
    np.testing.assert_allclose(W @ S @ W.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(S @ W.T @ W @ S, S, rtol=1e-12)


def test_correlations_are_factored() -> None:
    P = np.array([[4.0, 1.0], [1.0, 9.0]])
    L = correlation_factor(P, 0.0)
    np.testing.assert_allclose(L @ L.T, [[1.0, 1 / 6], [1 / 6, 1.0]], rtol=1e-12)


def test_a_lower_root_of_the_information_whitens_row_by_row() -> None:
    half = np.random.default_rng(2).normal(size=(9, 12))
    S = half @ half.T
    W = lower_information_root(S)
    np.testing.assert_array_equal(W, np.tril(W))
    np.testing.assert_allclose(W @ S @ W.T, np.eye(9), atol=1e-12)


def test_what_is_divided_from_the_right_comes_back() -> None:
    rng = np.random.default_rng(3)
    A, C = rng.normal(size=(5, 2, 3)), np.eye(3) + 0.2 * rng.normal(size=(5, 3, 3))
    np.testing.assert_allclose(right_divided(A, C) @ C, A, atol=1e-13)
    np.testing.assert_allclose(right_divided(A, C[0]) @ C[0], A, atol=1e-13)
    np.testing.assert_allclose(right_divided(np.eye(3), C) @ C, [np.eye(3)] * 5, atol=1e-13)


def test_leading_eigenvectors_span_what_all_eigenvectors_do() -> None:
    """Eigenvalues fall over twenty decades, as those of sources that are seen from afar."""
    rng = np.random.default_rng(5)
    turned, _ = np.linalg.qr(rng.normal(size=(60, 60)))
    values = 10.0 ** -np.linspace(0, 20, 60)
    matrix = (turned * values) @ turned.T
    for least in (1e-3, 1e-7):
        found = leading_eigenvectors((matrix + matrix.T) / 2, least)
        kept = turned[:, values >= least]
        assert found.shape == kept.shape
        np.testing.assert_allclose(found.T @ found, np.eye(found.shape[1]), atol=1e-12)
        # What is left out is 60 pivots of 1e-6 of the least at most; the next value is 2.2 times
        # smaller than the least, so that the space turns by 1e-4 at most.
        np.testing.assert_allclose(found @ (found.T @ kept), kept, atol=1e-4)
        # The largest comes last.
        np.testing.assert_allclose(abs(found[:, -1] @ turned[:, 0]), 1.0, atol=1e-9)


def test_of_equal_eigenvalues_all_vectors_lead() -> None:
    for matrix in (np.zeros((3, 3)), 2.0 * np.eye(3)):
        found = leading_eigenvectors(matrix, 1e-7)
        np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-15)


@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 60), columns=st.integers(1, 16))
def test_triangular_rows_have_the_same_squares(seed: int, rows: int, columns: int) -> None:
    """Also with fewer rows than columns."""
    given_rows = np.random.default_rng(seed).normal(size=(rows, columns))
    R = triangular_rows(given_rows)
    assert R.shape == (min(rows, columns), columns)
    np.testing.assert_array_equal(R, np.triu(R))
    # Rounding of at most 60 products of numbers of order one.
    np.testing.assert_allclose(R.T @ R, given_rows.T @ given_rows, rtol=0, atol=1e-11)


@given(n=st.integers(1, 12), share=st.floats(0, 1), seed=st.integers(0, 2**32 - 1))
def test_they_are_what_indexing_by_two_lists_gives(n: int, share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    matrix, at = rng.normal(size=(n, n)), rng.permutation(n)[: round(share * n)]
    half = rng.normal(size=(len(at), len(at)))
    block, both = half + half.T, np.ix_(at, at)
    np.testing.assert_array_equal(submatrix(matrix, at), matrix[both])
    added, wanted = matrix.copy(), np.zeros((n, n))
    wanted[both] = block
    add_upper(added, at, block)
    np.testing.assert_array_equal(added, matrix + np.triu(wanted))


def test_a_whole_krylov_space_has_all_eigenvalues() -> None:
    rng = np.random.default_rng(1)
    half = rng.normal(size=(30, 30))
    matrix = half + half.T
    values, vectors = eigenpairs(lambda v: matrix @ v, rng.normal(size=30), 30)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-9)
    np.testing.assert_allclose((vectors * values) @ vectors.T, matrix, atol=1e-9)


def test_the_largest_are_found_first() -> None:
    """Twenty directions of 200 that count, found in a space of 60."""
    rng = np.random.default_rng(2)
    basis = np.linalg.qr(rng.normal(size=(200, 200)))[0]
    true = np.append(np.geomspace(1e4, 10, 20), rng.uniform(0, 0.1, 180))
    values, _ = eigenpairs(lambda v: basis @ (true * (basis.T @ v)), rng.normal(size=200), 60)
    np.testing.assert_allclose(values[-20:], true[:20][::-1], rtol=1e-6)


def test_an_invariant_space_ends_the_iteration() -> None:
    """Five distinct eigenvalues: no vector is outside of five dimensions."""
    matrix = np.diag(np.repeat([1.0, 2.0, 3.0, 4.0, 5.0], 4))
    values, vectors = eigenpairs(lambda v: matrix @ v, np.ones(20), 20)
    np.testing.assert_allclose(values, [1, 2, 3, 4, 5], atol=1e-9)
    assert vectors.shape == (20, 5)


@given(st.integers(1, 30), st.integers(0, 10**6))
def test_the_inverse_of_a_factor_is_that_of_its_matrix(size: int, seed: int) -> None:
    root = np.random.default_rng(seed).standard_normal((size, size)) + 3 * np.eye(size)
    matrix = root @ root.T + np.eye(size)
    whole = np.linalg.inv(matrix)
    found = inverse_of_factor(np.asfortranarray(np.linalg.cholesky(matrix)))
    # Rounding, times the condition of a matrix whose diagonal stands out.
    np.testing.assert_allclose(found, whole, rtol=1e-7, atol=1e-9 * np.abs(whole).max())
    np.testing.assert_array_equal(found, found.T)
    assert found.flags.c_contiguous

"""Eigenvalues from products alone."""

import numpy as np

from l2m_gtsam.solve.lanczos import eigenpairs


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

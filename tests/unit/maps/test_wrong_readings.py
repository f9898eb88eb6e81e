"""Readings that are wrong by themselves make no sources, and hide none."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.found_sources import FoundSources
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.solve.linear_algebra import RowBlocks

NOISE_UT = 0.1
DIPOLE = SourceShape.dipole(np.array([1.0, 0.8, 0.5]), np.array([3.0, -2.0, 9.0]))
WRONG = 17
SPIKE_UT = np.array([-37.0, -21.0, 0.2])


def rows_with(field: FloatArray, points: FloatArray, seed: int) -> MarginalRows:
    """Return rows with noise that neighbours share and an unknown uniform field."""
    count = len(points)
    # Neighbouring readings in a slot of two, half of their noise alike.
    pair = np.linalg.inv(np.linalg.cholesky(NOISE_UT**2 * np.array([[1.0, 0.5], [0.5, 1.0]])))
    white = csr_array(np.kron(np.eye(count // 2), np.kron(pair, np.eye(3))))
    noise = np.linalg.inv(white.toarray()) @ np.random.default_rng(seed).normal(size=3 * count)
    return MarginalRows(
        points=points,
        residual=field + noise.reshape(-1, 3) + np.array([3.0, -1.0, 2.0]),
        whitening=white,
        nuisance=RowBlocks.of(white @ np.tile(np.eye(3), (count, 1))),
        prior=1e-4 * np.eye(3),
        slot=np.repeat(np.arange(count // 2), 2),
    )


def path() -> FloatArray:
    """Return a loop about 3 by 2 m, metres, shape (120, 3)."""
    turn = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    return np.column_stack([1 + 1.5 * np.cos(turn), np.sin(turn), np.zeros(120)])


def found_in(field: FloatArray, seed: int) -> FoundSources:
    """Return the sources of a field on the path of which one reading is wrong."""
    rows = rows_with(field, path(), seed)
    rows.residual[WRONG] += SPIKE_UT
    return find_sources(rows, rows.points, SourceSearchOptions(), None)


def test_a_reading_that_may_be_wrong_is_as_if_it_were_not_there() -> None:
    """Also where its noise is that of a neighbour in part."""
    field, _ = DIPOLE.field_and_gradient(path())
    rows = rows_with(field, path(), 1)
    keep = np.arange(len(rows)) != WRONG
    V = rows.whitening.toarray()
    S = np.linalg.inv(V.T @ V) + 1e4 * np.tile(np.eye(3), (len(rows), len(rows)))
    kept = np.repeat(keep, 3)
    e, D = rows.residual.ravel()[kept], DIPOLE.derivatives(path()).reshape(-1, 9)[kept, :6]
    known = np.linalg.inv(S[np.ix_(kept, kept)])
    without = rows.without([WRONG])
    features = DIPOLE.derivatives(path())[:, :, :6]
    # 1e4 uT^2 in common beside noise of 0.01, and 1e8 of the one reading: six of sixteen digits
    scale = np.abs(D.T @ known @ D).max()
    assert np.allclose(without.information(features), D.T @ known @ D, atol=1e-5 * scale)
    assert np.isclose(without.pull(rows.residual)[1], e @ known @ e, rtol=1e-5)
    assert rows.without([]) is rows


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_reading_makes_no_source(seed: int) -> None:
    found = found_in(np.zeros((120, 3)), seed)
    assert not len(found)
    assert found.wrong == (WRONG,)


def test_a_wrong_reading_hides_no_source() -> None:
    field, _ = DIPOLE.field_and_gradient(path())
    found = found_in(field, 4)
    assert len(found) == 1
    assert found.wrong == (WRONG,)
    error = (found.shapes[0].vector - DIPOLE.vector)[:6]
    # of six: chance one in a million
    assert np.abs(error / np.sqrt(np.diag(found.covariance)[:6])).max() < 5

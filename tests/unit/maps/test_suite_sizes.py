"""What errors of a survey's sensors are made of, as they are stated."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.maps.harmonic.suite_sizes import stated_modes

SCALES = np.array([1e-3, 5e-3, 0.3])  # metres, entries of C, uT


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9))
def test_modes_make_the_covariance_and_judged_ones_move_what_is_judged_alone(
    seed: int, size: int, rank: int
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.choice(SCALES, size)[:, None] * rng.normal(size=(size, rank))
    covariance, judged = root @ root.T, rng.random(size) < 0.5
    found = stated_modes(covariance, judged)
    sigma = np.sqrt(np.diag(covariance))
    scaled = found.root / sigma[:, None]
    # Directions of less than 1e-9 of a variance count as none.
    np.testing.assert_allclose(
        scaled @ scaled.T, covariance / np.outer(sigma, sigma), atol=1e-7 * size
    )
    assert found.root.shape[1] == len(found.judged) <= min(size, rank)
    assert not found.root[np.ix_(~judged, found.judged)].any()


def test_without_anything_to_judge_there_are_no_such_modes() -> None:
    found = stated_modes(np.diag([1.0, 4.0]), np.zeros(2, dtype=np.bool_))
    np.testing.assert_allclose(np.abs(found.root).sum(axis=1), [1.0, 2.0])
    assert not found.judged.any()

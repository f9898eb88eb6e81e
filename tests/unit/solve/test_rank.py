"""What the rank test finds and how it names it."""

import numpy as np

from l2m_gtsam.solve.rank import RankOptions, determinacy, timed_determinacy


def full(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(200, 15)) * 100


def test_rich_data_determine_everything() -> None:
    test = determinacy(full(), RankOptions())
    assert test.names == ()
    assert not test.touched.any()
    assert test.held.shape == (0, 15)


def test_a_column_without_signal_is_named() -> None:
    J = full()
    J[:, 2] = 1e-9
    test = determinacy(J, RankOptions())
    assert test.names == ("t_z",)
    assert list(np.flatnonzero(test.touched)) == [2]


def test_confounded_columns_are_named_together() -> None:
    """A vertical field of exactly -40 uT: C's third column and H move the readings alike."""
    J = full()
    for row in range(3):
        J[:, 3 + 3 * row + 2] = -40 * J[:, 12 + row]
    test = determinacy(J, RankOptions())
    assert sorted(test.names) == ["C_xz with H_x", "C_yz with H_y", "C_zz with H_z"]
    assert list(np.flatnonzero(test.touched)) == [5, 8, 11, 12, 13, 14]
    # What is held leaves the data's prediction unchanged: it lies in the null space.
    scale = RankOptions().scale()
    null = test.held * scale**2
    np.testing.assert_allclose(J @ null.T, 0, atol=1e-6 * np.abs(J).max())


def test_threshold_is_the_useful_sigma() -> None:
    """Sigma of t_x alone is 1 / |column|: 0.25 m counts as determined, 0.35 m does not."""
    for sigma, names in ((0.25, ()), (0.35, ("t_x",))):
        J = np.vstack([np.eye(15) * 1000, np.zeros((5, 15))])
        J[0, 0] = 1 / sigma
        assert determinacy(J, RankOptions()).names == names


def test_fewer_rows_than_parameters() -> None:
    test = determinacy(np.eye(15)[:6] * 1000, RankOptions())
    assert len(test.names) == 9


def timed(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(200, 16)) * 100


def test_a_time_offset_with_a_signal_of_its_own_is_told_apart() -> None:
    test = timed_determinacy(timed(), RankOptions())
    assert test.offset
    assert test.free == 16


def test_a_time_offset_that_looks_like_the_position_is_held() -> None:
    """A straight line at 2 m/s along the lidar's x axis: one second of it is t_x by 2 m."""
    J = timed()
    J[:, 15] = 2 * J[:, 0]
    test = timed_determinacy(J, RankOptions())
    assert not test.offset
    assert test.names == ()  # judged as if the offset were known
    assert test.free == 15
    np.testing.assert_allclose(test.imitation[:3], [2, 0, 0], atol=1e-3)


def test_the_rest_is_judged_with_the_offset_unknown() -> None:
    """Where both would do, t_x is known as well as the offset lets it: not at all here."""
    J = timed()
    J[:, 0] = 0.001 * np.random.default_rng(1).normal(size=200) + J[:, 15]
    options = RankOptions(useful_offset_s=0.5)
    test = timed_determinacy(J, options)
    # With t_x to 0.3 m the offset is known to 0.3 s.
    assert test.offset
    assert test.names == ("t_x",)


def test_without_motion_an_offset_is_held() -> None:
    J = timed()
    J[:, 15] = 0.0
    test = timed_determinacy(J, RankOptions())
    assert not test.offset
    np.testing.assert_array_equal(test.imitation, 0)

"""The rank test with priors against dense algebra."""

import gtsam
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from l2m_factors import D, T
from l2m_gtsam.calibration.determined import LOOSE, Cluster, Known, determinacies
from l2m_gtsam.calibration.priors import NO_PRIORS, Coordinate, Difference, Mount, Priors
from l2m_gtsam.data import FloatArray
from l2m_gtsam.solve.rank import RankOptions, timed_determinacy

OPTIONS = RankOptions()
SCALE = np.append(OPTIONS.scale(), OPTIONS.useful_offset_s)
SEEDS = st.integers(0, 1000)


def values(count: int) -> gtsam.Values:
    at = gtsam.Values()
    for sensor in range(count):
        at.insert(T(sensor), np.zeros(3))
        at.insert(D(sensor), np.concatenate([np.eye(3).ravel(), np.zeros(3)]))
    return at


def readings(seed: int, silent: int | None = None) -> FloatArray:
    """Return rows that know all sixteen to a tenth of what is of use, but one not at all."""
    J = np.random.default_rng(seed).normal(size=(60, 16)) / SCALE
    if silent is not None:
        J[:, silent] = 0.0
    return np.asarray(J)


def baseline(first: int, second: int, sigma: float = 0.002) -> Difference:
    return Difference((first, second), np.zeros(3), np.full(3, sigma), "baseline")


@given(SEEDS)
def test_rows_of_one_sensor_are_the_schur_complement(seed: int) -> None:
    """Of well-conditioned random rows of three sensors in a chain, to 1e-8 of the largest."""
    jacobians = {sensor: readings(seed + sensor) for sensor in range(3)}
    chain = Priors((baseline(0, 1, 0.1), baseline(1, 2, 0.1)))
    cluster = Cluster((0, 1, 2), jacobians, frozenset(), values(3), OPTIONS)
    information = np.zeros((48, 48))
    for sensor, J in jacobians.items():
        at = slice(16 * sensor, 16 * sensor + 16)
        information[at, at] += J.T @ J
    for first, second in ((0, 1), (1, 2)):
        row = np.zeros((3, 48))
        row[:, 16 * first : 16 * first + 3] = -np.eye(3) / 0.1
        row[:, 16 * second : 16 * second + 3] = np.eye(3) / 0.1
        information += row.T @ row
    for sensor in range(3):
        own = np.arange(16 * sensor, 16 * sensor + 16)
        rest = np.setdiff1d(np.arange(48), own)
        loose = np.diag(np.tile(1 / (LOOSE * SCALE), 2) ** 2)
        known = information[np.ix_(rest, rest)] + loose
        cross = information[np.ix_(rest, own)]
        expected = information[np.ix_(own, own)] - cross.T @ np.linalg.solve(known, cross)
        R = cluster.rows_of(sensor, chain)
        np.testing.assert_allclose(
            R.T @ R * np.outer(SCALE, SCALE),
            expected * np.outer(SCALE, SCALE),
            atol=1e-8 * np.abs(expected * np.outer(SCALE, SCALE)).max(),
        )


@given(SEEDS)
def test_without_priors_nothing_changes(seed: int) -> None:
    jacobians = {0: readings(seed, silent=2), 4: readings(seed + 1)}
    tests = determinacies(jacobians, NO_PRIORS, values(5), OPTIONS)
    for sensor, J in jacobians.items():
        expected = timed_determinacy(J, OPTIONS)
        assert tests[sensor].names == expected.names
        assert tests[sensor].free == expected.free
        assert tests[sensor].borrowed == {}
        np.testing.assert_array_equal(tests[sensor].held, expected.held)


def test_what_a_prior_lends_is_named_and_counted() -> None:
    jacobians = {0: readings(0, silent=2), 1: readings(1, silent=2)}
    height = Coordinate((0,), 2, 0.0, 0.01)
    tests = determinacies(jacobians, Priors((height, baseline(0, 1))), values(2), OPTIONS)
    assert tests[0].borrowed == {"t_z": "measured height"}
    assert tests[1].borrowed == {"t_z": "measured height and baseline"}
    for test in tests.values():
        assert test.names == ()
        assert test.free == 15  # of sixteen, one is lent


def test_two_priors_that_say_the_same_are_both_named() -> None:
    """Each would do: the height was measured, and so was that of a neighbour that is told."""
    jacobians = {0: readings(0, silent=2), 1: readings(1)}
    known = Priors((Coordinate((0,), 2, 0.0, 0.01), baseline(0, 1)))
    tests = determinacies(jacobians, known, values(2), OPTIONS)
    assert tests[0].borrowed == {"t_z": "measured height or baseline"}
    assert tests[1].borrowed == {}


def test_baselines_between_open_sensors_determine_nothing() -> None:
    jacobians = {sensor: readings(sensor, silent=2) for sensor in range(3)}
    chain = Priors((baseline(0, 1), baseline(1, 2)))
    for test in determinacies(jacobians, chain, values(3), OPTIONS).values():
        assert test.names == ("t_z",)
        assert test.free == 15


def test_a_sensor_that_is_not_solved_lends_nothing() -> None:
    jacobians = {0: readings(0, silent=2)}
    known = Priors((Coordinate((1,), 2, 0.0, 0.01), baseline(0, 1)))
    assert determinacies(jacobians, known, values(1), OPTIONS)[0].names == ("t_z",)


def test_a_mount_lends_a_column_of_c() -> None:
    mount = Mount((0,), np.eye(3), np.deg2rad(2.0), 0.05)
    jacobians = {0: readings(0, silent=5)}
    (test,) = determinacies(jacobians, Priors((mount,)), values(1), OPTIONS).values()
    assert test.borrowed == {"C_xz": "nominal rotation"}


def test_what_is_mostly_a_priors_leans_on_it() -> None:
    """A ruler twice as good as the readings, and one half as good."""
    jacobians = {0: readings(0)}
    alone = Known.of(jacobians[0], OPTIONS).sigma[2]
    for sigma, leans in ((alone / 2, True), (2 * alone, False)):
        known = Priors((Coordinate((0,), 2, 0.0, sigma),))
        (test,) = determinacies(jacobians, known, values(1), OPTIONS).values()
        assert test.borrowed == {}
        # Half of the readings' sigma: sqrt(5) times as much is known; twice: sqrt(5/4) times.
        assert test.leaning == ({"t_z": "measured height"} if leans else {})
        assert test.free == 16


def test_sigmas_are_those_of_the_normal_equations() -> None:
    J = readings(3)
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:15]
    np.testing.assert_allclose(Known.of(J, OPTIONS).sigma, expected, rtol=1e-9)

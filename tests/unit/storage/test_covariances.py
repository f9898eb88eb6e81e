"""Which covariances of messages are believed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.messages import CovarianceBuffer, usable

GOOD = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])


def correlated(seed: int) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * np.repeat([1e-2, 1e-3], 3)[:, None]
    return np.asarray(root @ root.T)


def is_usable(covariance: FloatArray) -> bool:
    return bool(usable(covariance[None])[0])


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_covariances_of_any_rank_are_usable_in_single_precision(seed: int, rank: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, rank)) * np.repeat([3.0, 1e-3], 3)[:, None]
    assert is_usable((root @ root.T).astype(np.float32).astype(np.float64))


def test_a_planar_covariance_is_usable_however_the_ground_lies() -> None:
    planar = np.diag([1e-4, 1e-4, 0, 0, 0, 1e-6])
    turn = np.kron(np.eye(2), Rotation.from_euler("xyz", [0.1, -0.2, 2.0]).as_matrix())
    assert is_usable(planar)
    assert is_usable(turn @ planar @ turn.T)


def changed(row: int, column: int, value: float) -> FloatArray:
    covariance = GOOD.copy()
    covariance[row, column] = value
    return covariance


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((6, 6)),
        np.full((6, 6), -1.0),
        changed(0, 0, np.nan),
        changed(5, 4, np.inf),
        changed(0, 0, -1.0),  # "unknown" in sensor_msgs/Imu
        changed(3, 3, -1e-9),
        changed(0, 1, 1e-4),  # not symmetric
        changed(0, 1, 1e300),
        GOOD + 1e-4 * (np.eye(6)[[1, 0, 2, 3, 4, 5]] - np.eye(6)) * 2,  # correlation beyond 1
        np.diag([1e-3, 1e-3, 1e6, 1e6, 1e6, 1e3]),  # the diagonal of simulated wheels
        np.diag([1e-3, 1e-3, 1e-3, 99999.0, 99999.0, 1e-3]),
    ],
)
def test_nonsense_is_not_usable(covariance: FloatArray) -> None:
    assert not is_usable(covariance)


@given(arrays(np.float64, (3, 6, 6), elements=st.floats(width=64)))
def test_no_numbers_break_the_judgement(covariance: FloatArray) -> None:
    judged = usable(np.concatenate([GOOD[None], covariance, GOOD[None]]))
    assert judged[[0, -1]].all()
    assert not judged[1:-1][~np.isfinite(covariance).all(axis=(1, 2))].any()


def filled(*covariances: FloatArray | None) -> CovarianceBuffer:
    buffer = CovarianceBuffer()
    for covariance in covariances:
        buffer.add(None if covariance is None else covariance.ravel())
    return buffer


def test_what_is_added_comes_back_by_index() -> None:
    matrices = [correlated(0), correlated(0), correlated(1), correlated(2), correlated(1)]
    found = filled(*matrices).at(np.array([4, 0, 1, 2]))
    assert found is not None
    for row, index in enumerate([4, 0, 1, 2]):
        # made symmetric: one rounding
        np.testing.assert_allclose(found[row], matrices[index], rtol=1e-15)


def test_a_covariance_that_never_changes_takes_little_memory() -> None:
    buffer = filled(*[GOOD] * 1000)
    assert len(buffer.values) == 2 * 36  # and the zero that every buffer starts with


@pytest.mark.parametrize("unknown", [None, np.zeros((6, 6)), changed(0, 0, np.nan), np.eye(3)])
def test_one_unknown_makes_all_unknown_if_its_pose_is_used(unknown: FloatArray | None) -> None:
    buffer = filled(GOOD, unknown, GOOD)
    assert buffer.at(np.arange(3)) is None
    assert buffer.at(np.array([0, 2])) is not None


def test_the_account() -> None:
    assert filled(GOOD, GOOD).account() == "with covariance"
    assert filled(None, np.zeros((6, 6))).account() == "their covariance is unknown: all zero"
    mixed = filled(GOOD, changed(0, 0, -1.0), GOOD, np.zeros((6, 6)))
    assert mixed.account() == "their covariance is unknown: not usable in 2 of 4"

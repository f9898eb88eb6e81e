"""Priors as factors: exact Jacobians, and errors and covariances in closed form."""

import re
from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_factors import (
    D,
    T,
    assert_jacobians_match,
    distance_prior,
    distortion_prior,
    held_directions,
    map_weights_information,
    map_weights_prior,
    pose_errors_prior,
    rotation_prior,
)
from l2m_gtsam.data import FloatArray

SEEDS = st.integers(0, 1000)


def places(*t: FloatArray) -> gtsam.Values:
    values = gtsam.Values()
    for sensor, place in enumerate(t):
        values.insert(T(sensor), place)
    return values


def distorted(C: FloatArray, H: FloatArray) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(D(0), np.concatenate([C.ravel(), H]))
    return values


@given(SEEDS)
def test_jacobians_are_those_of_central_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    at = distorted(R + rng.normal(0, 0.1, (3, 3)), rng.normal(0, 10, 3))
    assert_jacobians_match(rotation_prior(0, R, 0.03, 0.05), at)
    # Sensors at least a decimetre apart: second derivatives go with one over the distance.
    apart = rng.normal(size=3)
    t = rng.normal(size=3)
    values = places(t, t + apart * (0.1 / np.linalg.norm(apart) + 1))
    assert_jacobians_match(distance_prior(0, 1, 0.3, 0.002), values)


@given(SEEDS)
def test_a_rotation_is_as_likely_as_its_angle(seed: int) -> None:
    """Far below the stretch's and the turn's sigma all is linear: |w|^2 / (2 turn^2 + stretch^2).

    The antisymmetric part of a matrix of stretches alone has twice the length of w, squared.
    """
    rng = np.random.default_rng(seed)
    R, w = Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 1e-5, 3)
    C = Rotation.from_rotvec(w).as_matrix() @ R
    factor = rotation_prior(0, R, 0.03, 0.02)
    expected = 0.5 * (2 * w @ w) / (2 * 0.03**2 + 0.02**2)
    # To first order in angles of 1e-5.
    assert factor.error(distorted(C, rng.normal(0, 10, 3))) == pytest.approx(expected, rel=1e-4)


@given(SEEDS)
def test_a_symmetric_stretch_is_as_likely_as_its_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, E = Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 0.1, (3, 3))
    E = E + E.T
    factor = rotation_prior(0, R, 0.03, 0.02)
    expected = 0.5 * np.sum(E**2) / 0.02**2
    at = distorted((np.eye(3) + E) @ R, np.zeros(3))
    assert factor.error(at) == pytest.approx(expected, rel=1e-9)


def test_a_distance_is_missed_by_so_many_sigmas() -> None:
    factor = distance_prior(0, 1, 0.5, 0.01)
    values = places(np.zeros(3), np.array([0.0, 0.3, 0.4 * (1 + 1e-16)]))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-20)
    assert factor.error(places(np.zeros(3), np.array([0.0, 0.0, 0.53]))) == pytest.approx(4.5)


def test_two_sensors_at_one_point_have_a_finite_distance() -> None:
    jacobian, b = (
        distance_prior(0, 1, 0.5, 0.01).linearize(places(np.zeros(3), np.zeros(3))).jacobian()
    )
    np.testing.assert_array_equal(jacobian, np.zeros((1, 6)))
    assert b == pytest.approx([50.0])


def test_wrong_priors_are_refused_in_one_line() -> None:
    wrong: tuple[tuple[Callable[[], object], str], ...] = (
        (lambda: distance_prior(1, 1, 0.5, 0.1), "second: 1 is the first, too; give two sensors"),
        (
            lambda: distortion_prior(0, np.ones(9), 0.1),
            "C0: of shape (9,); needed is (3, 3)",
        ),
        (
            lambda: rotation_prior(0, np.ones(9), 0.1, 0.1),
            "R_mag_lidar: of shape (9,); needed is (3, 3)",
        ),
        (
            lambda: held_directions(0, np.ones((2, 12)), np.ones(15)),
            "directions: of shape (2, 12); needed is (2, 15)",
        ),
        (
            lambda: pose_errors_prior([0.5, 1.0]),
            "correlation: 1 of knot 1; needed is 0 to 1 (excluded)",
        ),
        (
            lambda: map_weights_prior({3: 2, 5: 1}, np.eye(2)),
            "root_information: of shape (2, 2); needed is (3, 3)",
        ),
        (
            lambda: map_weights_information({3: 2, 5: 1}, np.eye(2)),
            "information: of shape (2, 2); needed is (3, 3)",
        ),
    )
    for made, line in wrong:
        with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
            made()


def test_arrays_that_are_written_into_later_change_no_prior() -> None:
    C0, directions, values = np.eye(3), np.ones((1, 15)), gtsam.Values()
    values.insert(T(0), np.ones(3))
    values.insert(D(0), np.ones(12))
    priors = (distortion_prior(0, C0, 0.1), held_directions(0, directions, np.zeros(15)))
    before = [prior.error(values) for prior in priors]
    C0[:], directions[:] = 0.0, 0.0
    assert [prior.error(values) for prior in priors] == before

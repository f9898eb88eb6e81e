"""Magnetic readings in a pose graph of somebody else's, with keys of its own."""

import re
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from examples.pose_graph import DipoleField, driven, error_m, off_line, on_line, without
from l2m_factors import Calibrations, assert_jacobians_match, magnetic_pose_factor
from tests.support.central_differences import slopes

KEY = gtsam.symbol("q", 7)
MASK = (
    "sensor: bool of shape (2,); needed are integers of shape (n,); np.flatnonzero makes them of a "
    "mask"
)


@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=30)
def test_derivatives_are_those_of_finite_differences(seed: int) -> None:
    rng, values = np.random.default_rng(seed), gtsam.Values()
    values.insert(KEY, gtsam.Pose3.Expmap(rng.normal(0, [0.5] * 3 + [0.3] * 3)))
    distortion = rng.normal(0, 0.2, (3, 12))
    distortion[:, [0, 4, 8]] += 1.0
    sensors = Calibrations(rng.normal(0, 0.2, (3, 3)), distortion, np.zeros(3))
    noise = gtsam.noiseModel.Diagonal.Sigmas(rng.uniform(0.1, 1.0, 12))
    factor = magnetic_pose_factor(
        KEY, DipoleField(), sensors, np.array([0, 2, 1, 0]), rng.normal(0, 30, (4, 3)), noise
    )
    assert_jacobians_match(factor, values)


def known_sensors() -> Calibrations:
    return Calibrations(
        np.ones((2, 3)), np.tile(np.append(np.eye(3), [3, -2, 1]), (2, 1)), np.zeros(2)
    )


def factor_of(**other: Any) -> gtsam.CustomFactor:
    """Return a factor of two readings, but for some of its arguments."""
    given: dict[str, Any] = {
        "sensors": known_sensors(),
        "sensor": np.array([0, 1]),
        "field": np.full((2, 3), 20.0),
        "noise": gtsam.noiseModel.Isotropic.Sigma(6, 0.3),
    }
    return magnetic_pose_factor(KEY, DipoleField(), **given | other)


def test_arrays_that_are_written_into_later_change_nothing() -> None:
    """As where one buffer takes all readings."""
    values, known = gtsam.Values(), known_sensors()
    values.insert(KEY, gtsam.Pose3())
    sensor, field = np.array([0, 1]), np.full((2, 3), 20.0)
    factor = factor_of(sensor=sensor, field=field, sensors=known)
    before = factor.error(values)
    for array in (sensor, field, known.t, known.distortion, known.offset):
        array[:] = 0
        assert factor.error(values) == before


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"field": np.ones(3)}, "field: of shape (3,); needed is (2, 3)"),
        ({"field": np.ones((1, 3))}, "field: of shape (1, 3); needed is (2, 3)"),
        ({"field": np.ones((2, 1))}, "field: of shape (2, 1); needed is (2, 3)"),
        ({"field": 50.0}, "field: of shape (); needed is (2, 3)"),
        ({"field": None}, "field: of shape (); needed is (2, 3)"),
        ({"field": [[1, 2, 3], [4]]}, "field: not an array of numbers; needed is shape (2, 3)"),
        (
            {"field": [[1, 2, 3], [4, np.nan, 6]]},
            "field: row 1 is not finite; leave it out or give numbers",
        ),
        ({"sensor": np.array([0, -1])}, "sensor: -1 is negative; indices count from 0"),
        ({"sensor": np.array([0, 2])}, "sensor: 2; there are calibrations of 2 sensors, from 0"),
        (
            {"sensor": np.array([True, True])},
            MASK,
        ),
        (
            {"noise": gtsam.noiseModel.Isotropic.Sigma(3, 0.3)},
            "noise: of dimension 3; needed is 6",
        ),
        ({"noise": 0.3}, "noise: 0.3; needed is a gtsam.noiseModel of dimension 6"),
        (
            {"sensors": Calibrations(np.ones((2, 3)), np.ones((2, 9)), np.zeros(2))},
            "Calibrations.distortion: of shape (2, 9); needed is (2, 12)",
        ),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(wrong: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(line)}$"):
        factor_of(**wrong)


def test_the_field_of_the_example_has_its_gradient() -> None:
    """Central differences of 0.1 mm; the third derivative adds less than 1e-5 uT/m here."""
    points = np.random.default_rng(2).uniform(-1, 1, (20, 3))
    _, gradient = DipoleField().field_and_gradient(points)
    expected = slopes(lambda x: DipoleField().field_and_gradient(x)[0], points, 1e-4)
    np.testing.assert_allclose(gradient, expected, atol=1e-4)


def test_a_graph_of_others_gains_off_line_and_in_isam2() -> None:
    """Half of the error at most is left, and both solvers end at the same poses."""
    drive, dipoles = driven(DipoleField()), DipoleField()
    before = error_m(drive, without(drive))
    together, one_by_one = off_line(drive, dipoles), on_line(drive, dipoles)
    assert error_m(drive, together) < before / 2
    assert error_m(drive, one_by_one) < before / 2
    # iSAM2 relinearises what has moved by more than 1 cm.
    assert abs(error_m(drive, together) - error_m(drive, one_by_one)) < 0.01

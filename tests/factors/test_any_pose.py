"""Magnetic readings in a pose graph of somebody else's, with keys of its own."""

import gtsam
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from examples.pose_graph import DipoleField, driven, error_m, off_line, on_line, without
from l2m_factors import Calibrations, assert_jacobians_match, magnetic_pose_factor
from tests.support.central_differences import slopes

KEY = gtsam.symbol("q", 7)


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

"""A key pose marginalised after a step of odometry, against the product with the whole Jacobian."""

import gtsam
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.online.belief import POSE, SENSOR, PredictedBelief, WhitenedMeasurement
from l2m_gtsam.slam.online.measurements import log_density


@pytest.mark.parametrize("sensors", [0, 1, 5])
def test_marginalising_is_the_product_with_the_whole_jacobian(sensors: int) -> None:
    """Of any joint covariance, sensors and step correlated with all else."""
    rng, count = np.random.default_rng(sensors), POSE + SENSOR * sensors
    root = rng.normal(size=(count + POSE, count + POSE))
    joint = root @ root.T
    pose, step = (gtsam.Pose3.Expmap(rng.normal(size=POSE)) for _ in range(2))
    nothing = KnownSensors((), *(np.empty((0, n)) for n in (3, 12)), *[np.empty(0)] * 3)
    after = PredictedBelief(pose, nothing, joint, step).marginalize_previous()
    J = np.eye(count, count + POSE)
    J[:POSE, :POSE], J[:POSE, -POSE:] = step.inverse().AdjointMap(), np.eye(POSE)
    # Sums of twice six products: rounding.
    np.testing.assert_allclose(after.covariance, J @ joint @ J.T, rtol=1e-12, atol=1e-12)
    assert after.pose.equals(pose.compose(step), 1e-12)


def test_the_density_of_a_measurement_is_that_of_its_residual() -> None:
    """With the error of the belief and its own of unit variance."""
    rng = np.random.default_rng(3)
    root, J = rng.normal(size=(6, 6)), rng.normal(size=(9, 6))
    P, residual = root @ root.T, 3 * rng.normal(size=9)
    expected = multivariate_normal(cov=J @ P @ J.T + np.eye(9)).logpdf(residual)
    found = log_density(WhitenedMeasurement(residual, J), P)
    assert found - 4.5 * np.log(2 * np.pi) == pytest.approx(expected, abs=1e-9)

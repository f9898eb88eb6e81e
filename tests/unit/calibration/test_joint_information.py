"""All variables of the last graph together, against dense algebra."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from l2m_gtsam.calibration.joint_information import Rows, leverage
from l2m_gtsam.data import FloatArray


@pytest.mark.parametrize("apart", [True, False])
def test_a_fit_takes_of_each_reading_what_dense_algebra_says(apart: bool) -> None:
    """Of readings by themselves, and of such whose errors have something in common."""
    rng, count, weights = np.random.default_rng(4), 5, 4
    rows, at = 3 * count, np.array([5, 1, 3, 0])
    J = rng.standard_normal((rows, weights))
    root = np.tril(rng.standard_normal((rows, rows))) + 4 * np.eye(rows)
    whitening: FloatArray = np.asarray(np.linalg.inv(root))
    if apart:
        readings = np.arange(count)
        whitening = whitening.reshape(count, 3, count, 3)[readings, :, readings]
        root = block_diag(*np.linalg.inv(whitening))
    information = np.eye(6)
    information[np.ix_(at, at)] += J.T @ np.linalg.solve(root @ root.T, J)
    covariance: FloatArray = np.asarray(np.linalg.inv(information))
    white_J: FloatArray = np.asarray(np.linalg.solve(root, J))
    white = Rows(0, at, white_J, np.zeros(rows), np.arange(count))
    fitted = np.diag(J @ covariance[np.ix_(at, at)] @ J.T).reshape(-1, 3).sum(axis=1)
    whole = np.diag(root @ root.T).reshape(-1, 3).sum(axis=1)
    found = leverage(covariance, white, whitening)
    np.testing.assert_allclose(found, fitted / whole, rtol=1e-9)  # well conditioned

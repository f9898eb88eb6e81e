"""Checks of factors, in the manner of ``numpy.testing``."""

import gtsam
import numpy as np

from l2m_factors.field_map import FloatArray


def assert_jacobians_match(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, *, rtol: float = 1e-6, step: float = 1e-5
) -> None:
    """Raise an AssertionError if a factor's Jacobians differ from central differences.

    Works on the manifold for every variable type and every Gaussian noise model.

    Parameters
    ----------
    factor
        The factor to test.
    values
        Values of at least its variables.
    rtol
        Largest difference, relative to the largest entry of the variable's Jacobian.
    step
        Step of the differences in the variable's tangent space.

    Raises
    ------
    AssertionError
        Names the variable and shows both matrices.
    """
    for key, analytic in _analytic_blocks(factor, values).items():
        numeric = _central_difference(factor, values, key, analytic.shape[1], step)
        scale = max(float(np.abs(numeric).max(initial=0.0)), np.finfo(float).tiny)
        np.testing.assert_allclose(
            analytic / scale,
            numeric / scale,
            rtol=0,
            atol=rtol,
            err_msg=f"Jacobian by {gtsam.DefaultKeyFormatter(key)}, in units of {scale:.6g}",
        )


def _analytic_blocks(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> dict[int, FloatArray]:
    linear = factor.linearize(values)
    keys = linear.keys()
    widths = [len(values.zeroVectors().at(key)) for key in keys]
    jacobian, _ = linear.jacobian()
    return dict(zip(keys, np.split(jacobian, np.cumsum(widths)[:-1], axis=1), strict=True))


def _central_difference(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, key: int, width: int, step: float
) -> FloatArray:
    columns = []
    for delta in step * np.eye(width):
        ahead = _whitened_error(factor, values, key, delta)
        behind = _whitened_error(factor, values, key, -delta)
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, axis=1)


def _whitened_error(
    factor: gtsam.NonlinearFactor, values: gtsam.Values, key: int, delta: FloatArray
) -> FloatArray:
    tangent, own = values.zeroVectors(), gtsam.VectorValues()
    own.insert(key, delta)
    tangent.update(own)
    _, b = factor.linearize(values.retract(tangent)).jacobian()
    return np.asarray(-b)

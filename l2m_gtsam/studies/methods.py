"""Ways to calibrate one sensor that studies compare, each from a given start."""

import numpy as np

from l2m_gtsam.data import Distortion, FloatArray, Readings
from l2m_gtsam.graph.alternation import OneKeyOptions, alternate, start_estimate
from l2m_gtsam.graph.calibration import Estimate
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.solve.closed_form import ClosedFormOptions

# Of the paper, which leaves its value open: small against the readings' information.
PUBLISHED_RIDGE = 1e-3
SETTLED_M = 1e-5


def two_step(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, closed_form: ClosedFormOptions
) -> Estimate:
    """Return where closed form and translation graph settle in turns, without a joint graph.

    Parameters
    ----------
    readings
        Of one sensor.
    field_map
        The magnetic map.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    closed_form
        The inner step.
    """
    options = OneKeyOptions(closed_form=closed_form, alternation_readings=len(readings))
    start = start_estimate(t_start[None], options)
    return alternate(readings, field_map, start, options, lambda *_: None).estimate


def published(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, steps: int = 100
) -> Estimate:
    """Return where the paper's algorithm 1 ends, as it is written.

    Fields and readings are truncated together to rank three without centring, H is a column of
    ones within the ridge, weights are the map's variance to the power -2, and the Gauss-Newton
    step for t knows no weights. The printed Jacobian and step have a rotation and a transpose too
    few; with them nothing converges, and they are mended here.

    Parameters
    ----------
    readings
        Of one sensor; those outside of the map count as the map extends them.
    field_map
        The magnetic map.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    steps
        The most iterations.
    """
    t, R = t_start.copy(), readings.R_map_lidar
    for _ in range(steps):
        sample = field_map.query(R @ t + readings.p_map_lidar)
        keep = sample.inside
        R_in, b_meas = R[keep], readings.field[keep]
        b_lidar = np.einsum("nji,nj->ni", R_in, sample.field[keep])
        found = published_distortion(b_lidar, b_meas, sample.variance[keep].mean(axis=1))
        residual = found.apply(b_lidar) - b_meas
        J = np.einsum("ij,nkj,nkl,nlm->nim", found.C, R_in, sample.gradient[keep], R_in)
        step = np.linalg.lstsq(J.reshape(-1, 3), -residual.ravel(), rcond=None)[0]
        t += step
        if np.abs(step).max() < SETTLED_M:
            break
    none = np.zeros(1)
    return Estimate(t[None], found.vector()[None], np.ones(1), none, none)


def published_distortion(
    b_lidar: FloatArray, b_meas: FloatArray, map_variance: FloatArray
) -> Distortion:
    """Return C and H by the paper's closed form.

    Parameters
    ----------
    b_lidar, b_meas
        Field that the map predicts in the lidar frame, and readings, in uT, shape (N, 3).
    map_variance
        Of the prediction in uT^2, shape (N,).
    """
    U, s, Vt = np.linalg.svd(np.hstack([b_meas, b_lidar]), full_matrices=False)
    truncated = (U[:, :3] * s[:3]) @ Vt[:3]
    weights = 1 / np.maximum(map_variance, np.finfo(float).tiny ** 0.25)
    X = weights[:, None] * np.hstack([truncated[:, 3:], np.ones((len(b_lidar), 1))])
    Y = weights[:, None] * truncated[:, :3]
    normal = X.T @ X + PUBLISHED_RIDGE * np.eye(4)
    A = np.linalg.solve(normal, X.T @ Y).T
    return Distortion(A[:, :3], A[:, 3])

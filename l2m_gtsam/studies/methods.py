"""Ways to calibrate one sensor that studies compare, each from a given start."""

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions, alternate, start_estimate
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.progress import silent
from l2m_gtsam.solve.closed_form import (
    MIN_READINGS,
    ClosedFormOptions,
    Weighting,
    fit_distortion,
    row_weights,
)

PUBLISHED = ClosedFormOptions(weighting=Weighting.PAPER)
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
    return alternate(readings, field_map, start, options, silent).estimate


def published(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, steps: int = 100
) -> Estimate | None:
    """Return where the paper's algorithm 1 ends, None if that is off the map.

    Weights of the closed form are the map's variance to the power -2, as the printed norm has
    them; the Gauss-Newton step for t knows no weights. Three slips of the print are mended, for
    with them nothing converges: the Jacobian lacks a rotation and the step a transpose; and
    truncating fields and readings together to rank three without an intercept leaves nothing for
    H to explain, which comes out as zero. Here H follows from the means.

    Parameters
    ----------
    readings
        Of one sensor; those that a step puts outside of the map are left out of the next.
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
        if keep.sum() < MIN_READINGS:
            return None
        R_in, b_meas = R[keep], readings.field[keep]
        b_lidar = np.einsum("nji,nj->ni", R_in, sample.field[keep])
        weights = row_weights(sample.variance[keep].mean(axis=1), 0.0, PUBLISHED.weighting)
        found = fit_distortion(b_lidar, b_meas, weights, PUBLISHED).distortion
        residual = found.apply(b_lidar) - b_meas
        J = np.einsum("ij,nkj,nkl,nlm->nim", found.C, R_in, sample.gradient[keep], R_in)
        step = np.linalg.lstsq(J.reshape(-1, 3), -residual.ravel(), rcond=None)[0]
        t += step
        if np.abs(step).max() < SETTLED_M:
            break
    none = np.zeros(1)
    return Estimate(t[None], found.vector()[None], np.ones(1), none, none)

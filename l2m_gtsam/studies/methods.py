"""Methods that ours is compared with, each from a given start, and the Cramer-Rao bound."""

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np
from scipy.optimize import least_squares

from l2m_gtsam.calibration.alternation import OneKeyOptions, alternate, start_estimate
from l2m_gtsam.calibration.coverage import UncertainMap
from l2m_gtsam.calibration.factor_graph import Estimate, batch_readings, reading_graph
from l2m_gtsam.calibration.forecast import stated_at
from l2m_gtsam.calibration.one_key import solve_one_key
from l2m_gtsam.calibration.optimise import Optimizer, optimise
from l2m_gtsam.calibration.start.global_start import StartOptions, find_starts_around
from l2m_gtsam.calibration.view import QueryableMap, StandIns, observe
from l2m_gtsam.data import BoolArray, Distortion, FloatArray, KnownSensor, Readings
from l2m_gtsam.errors import MapError
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.solve.closed_form import (
    MIN_READINGS,
    ClosedFormOptions,
    Weighting,
    fit_distortion,
    row_weights,
)
from l2m_gtsam.solve.noise import reading_covariance

UNKNOWNS = 15  # of a sensor: t, C and H
PUBLISHED = ClosedFormOptions(weighting=Weighting.PAPER)
SETTLED_M, PUBLISHED_STEPS = 1e-5, 100


BLOCKS = (slice(0, 3), slice(3, 12), slice(12, 15))  # t, C, H


def errors_of(vector: FloatArray, sensor: KnownSensor) -> FloatArray:
    """Return the lengths of the errors of t, C (Frobenius) and H of N results, shape (N, 3).

    ``vector`` is t in metres, C row by row and H in microtesla, shape (N, 15).
    """
    off = vector - sensor.vector()
    return np.column_stack([np.linalg.norm(off[:, block], axis=1) for block in BLOCKS])


@dataclass(frozen=True)
class MethodResult:
    """Where a method ended from N starts.

    Attributes
    ----------
    vector
        t, C row by row and H; NaN without a result, shape (N, 15).
    solves
        That were computed.
    seconds
        Of one core for a calibration from one start.
    """

    vector: FloatArray
    solves: int
    seconds: float


@dataclass(frozen=True)
class OneKeyResult(MethodResult):
    """Where our method ended, and where it began.

    Attributes
    ----------
    t_found
        Where the search found the sensor in metres, NaN for nowhere, shape (N, 3).
    ambiguous
        Which of these places are not clearly the best, shape (N,).
    """

    t_found: FloatArray
    ambiguous: BoolArray


def one_key(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    search: StartOptions,
    options: OneKeyOptions,
) -> OneKeyResult:
    """Return where the full method ends from each start, shape (N, 3).

    Starts from which the search finds the same place share the solve from there.
    """
    begin = process_time()
    found = [each[0] for each in find_starts_around(readings, field_map, t_start, search)]
    none = np.full(3, np.nan)
    t_found = np.array([none if each is None else each.t_lidar_mag for each in found])
    ambiguous = np.array([each is not None and each.ambiguous(search.clear) for each in found])
    searched = (process_time() - begin) / len(t_start)
    places, which = np.unique(t_found, axis=0, return_inverse=True)
    begin, somewhere = process_time(), np.flatnonzero(np.isfinite(places).all(axis=1))
    ends = np.full((len(places), UNKNOWNS), np.nan)
    for row in somewhere:
        solution = solve_one_key(readings, field_map, places[row][None], options)
        if solution.solved:
            ends[row] = solution.estimate.vector(0)
    solved = (process_time() - begin) / max(len(somewhere), 1)
    return OneKeyResult(ends[which.ravel()], len(somewhere), searched + solved, t_found, ambiguous)


def two_step(
    readings: Readings, field_map: QueryableMap, t_start: FloatArray, closed_form: ClosedFormOptions
) -> FloatArray:
    """Return where closed form and translation graph settle in turns, without a joint graph.

    As t, C row by row and H, shape (15,).

    Parameters
    ----------
    readings
        Of one sensor.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    closed_form
        The inner step.
    """
    options = OneKeyOptions(closed_form=closed_form, alternation_readings=len(readings))
    start = start_estimate(t_start[None], options)
    every = StandIns.of(readings, len(readings))
    return alternate(readings, every, field_map, start, options, silent).estimate.vector(0)


def as_published(readings: Readings, field_map: QueryableMap, t_start: FloatArray) -> FloatArray:
    """Return t, C row by row and H where the paper's algorithm 1 ends, (15,); NaN off the map.

    Weights of the closed form are the map's variance to the power -2, as the printed norm has
    them; the Gauss-Newton step for t knows no weights. Three slips of the print are mended, for
    with them nothing converges: the Jacobian lacks a rotation and the step a transpose; and
    truncating fields and readings together to rank three without an intercept leaves nothing for
    H to explain, which comes out as zero. Here H follows from the means.

    Parameters
    ----------
    readings
        Of one sensor; those that a step puts outside of the map are left out of the next.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    """
    t, R = t_start.copy(), readings.R_map_lidar
    for _ in range(PUBLISHED_STEPS):
        sample = field_map.query(R @ t + readings.p_map_lidar)
        keep = sample.inside
        if keep.sum() < MIN_READINGS:
            return np.full(UNKNOWNS, np.nan)
        R_in, b_meas = R[keep], readings.field[keep]
        b_lidar = np.einsum("nji,nj->ni", R_in, sample.field[keep])
        weights = row_weights(sample.variance[keep].mean(axis=1), 0.0, PUBLISHED.weighting)
        found = fit_distortion(b_lidar, b_meas, weights, PUBLISHED).distortion
        residual = found.apply(b_lidar) - b_meas
        # e = C R' B(R t + p) + H - z, and so de/dt = C R' G R with the map's gradient G.
        J = np.einsum("ij,nkj,nkl,nlm->nim", found.C, R_in, sample.gradient[keep], R_in)
        # Gauss-Newton without weights, as printed.
        step = np.linalg.lstsq(J.reshape(-1, 3), -residual.ravel(), rcond=None)[0]
        t += step
        if np.abs(step).max() < SETTLED_M:
            break
    return np.concatenate([t, found.vector()])


def cramer_rao(
    readings: Readings,
    field_map: QueryableMap,
    truth: FloatArray,
    noise: float,
    options: OneKeyOptions,
) -> FloatArray:
    """Return the least covariance of (t, C, H, time offset) of one sensor, shape (16, 16).

    It is the inverse of the information at the truth, with the map's errors unknown, too, and
    their prior from the survey (the Bayesian bound of Van Trees).

    Parameters
    ----------
    readings
        Of the sensor, with the poses that they have at its true time offset, as far as these are
        known: errors of poses are unknowns, too.
    field_map
        The magnetic map, which has to know how its errors are correlated.
    truth
        Of t, C row by row, H and the time offset, shape (16,).
    noise
        Standard deviation of the sensor's noise in uT.
    options
        Which of the readings enter, and how long errors of poses last.

    Returns
    -------
    Infinite for what the data do not determine; NaN if too few readings lie inside the map.

    Raises
    ------
    MapError
        The map does not know how its errors are correlated.
    """
    if not isinstance(field_map, UncertainMap):
        raise MapError("a bound needs a map that models how its errors are correlated: harmonic")
    known = Estimate(truth[None, :3], truth[None, 3:15], np.array([noise]), np.zeros(1), truth[15:])
    view = observe(readings, field_map, known, options.min_readings)
    if not view.sensors:
        return np.full((16, 16), np.nan)
    # A bound knows that the drive's frame is the map's.
    shared = options.model_copy(update={"uncertainty": Uncertainty.FULL, "warp_m": 0.0})
    (solution,) = stated_at(view, field_map, known, shared).solved
    return solution.joint_covariance


def levenberg_marquardt(
    readings: Readings,
    field_map: QueryableMap,
    t_start: FloatArray,
    noise: float,
    options: OneKeyOptions,
) -> FloatArray:
    """Return where one optimisation of one sensor's joint graph ends, metres, shape (3,).

    C and H start from the closed form at the start. All readings take part, also those that a
    wrong start places outside of the map, which answers smoothly there: with only those inside
    many starts would leave nothing to optimise.

    Parameters
    ----------
    readings
        Of one sensor.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    noise
        Known standard deviation of the readings in uT.
    options
        Closed form, factors, and the largest number of linearisations.
    """
    distortion = closed_form(readings, field_map, t_start, options)
    start = Estimate(t_start[None], distortion.vector()[None], np.array([noise]), *np.zeros((2, 1)))
    covariance = reading_covariance(np.full(len(readings), noise), np.zeros((len(readings), 3, 3)))
    # The map counts as exact: a baseline that does not know its errors.
    graph = reading_graph(batch_readings(readings, field_map), covariance, options.factors)
    end = optimise(graph, start.values([0]), Optimizer.LM, options.joint_iterations)
    return np.asarray(start.updated(end.values, [0]).t[0])


def closed_form(
    readings: Readings, field_map: QueryableMap, t: FloatArray, options: OneKeyOptions
) -> Distortion:
    """Return C and H of one sensor at a place in the lidar frame in metres, shape (3,)."""
    R = readings.R_map_lidar
    field, _ = field_map.field_and_gradient(R @ t + readings.p_map_lidar)
    b_lidar = np.einsum("nji,nj->ni", R, field)
    weights = np.ones(len(readings))
    return fit_distortion(b_lidar, readings.field, weights, options.closed_form).distortion


def numeric_least_squares(
    readings: Readings,
    field: Callable[[FloatArray], FloatArray],
    t_start: FloatArray,
    steps: int = 30,
) -> FloatArray:
    """Return t, C row by row and H of S sensors, shape (S, 15).

    Parameters
    ----------
    readings
        Of all sensors.
    field
        From places of the map frame in metres, shape (N, 3), to uT, shape (N, 3).
    t_start
        Where to start in the lidar frame in metres, shape (S, 3); C starts from I, H from zero.
    steps
        At most.
    """
    R, sensor = readings.R_map_lidar, readings.sensor

    def residuals(x: FloatArray) -> FloatArray:
        each = x.reshape(-1, UNKNOWNS)[sensor]
        places = np.einsum("nij,nj->ni", R, each[:, :3]) + readings.p_map_lidar
        b_lidar = np.einsum("nji,nj->ni", R, field(places))
        C, H = each[:, 3:12].reshape(-1, 3, 3), each[:, 12:]
        return np.asarray(np.einsum("nij,nj->ni", C, b_lidar) + H - readings.field).ravel()

    ideal = np.tile(np.concatenate([np.eye(3).ravel(), np.zeros(3)]), (len(t_start), 1))
    start = np.hstack([t_start, ideal])
    # Columns in metres, ratios and microtesla: scaled by their own lengths.
    end = least_squares(residuals, start.ravel(), x_scale="jac", max_nfev=steps)
    return np.asarray(end.x.reshape(-1, UNKNOWNS))

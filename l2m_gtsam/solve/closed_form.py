r"""Distortion from pairs of fields, in closed form: OLS, TLS, RRTLS and w-RRTLS.

All solve ``b_meas = C b_lidar + H`` for N pairs. They differ in three steps that can be taken or
not: weights, truncation, ridge.

1. Rows are weighted and centred with the weighted means, so that H follows from the means and is
   never penalised (mixed LS-TLS; the paper omits the intercept).
2. TLS truncates the compound matrix [b_lidar b_meas] to rank 3 (paper, section III-C).
3. The ridge pulls C towards the identity: ``lambda ||C - I||_F^2`` (the paper penalises the data).

Everything after step 1 works on the 6 x 6 triangular factor of the compound matrix.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import assert_never

import numpy as np
from pydantic import Field

from l2m_gtsam.data import Distortion, FloatArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.options import Options

# Times the largest squared singular value: from rounding to a solution of next to nothing, 20 a
# decade.
GRID = np.logspace(-14, 2, 321)
MIN_READINGS = 4  # non-coplanar: C has nine numbers, H three, a reading three


@dataclass(frozen=True)
class RidgePath:
    """Solutions of a ridge problem along a grid of strengths.

    Attributes
    ----------
    strength
        Lambda, shape (L,).
    residual
        Sum of squared residuals, including what no A can explain, shape (L,).
    size
        Sum of squared entries of the solution, shape (L,).
    freedom
        Effective number of parameters per column of Y, shape (L,).
    """

    strength: FloatArray
    residual: FloatArray
    size: FloatArray
    freedom: FloatArray


def ridge_path(X: FloatArray, Y: FloatArray, unexplained: float = 0.0) -> RidgePath:
    """Return the solutions for a grid of strengths.

    Parameters
    ----------
    X, Y
        Regressors and observations, shapes (M, P) and (M, Q).
    unexplained
        Squared residual that was removed from X and Y beforehand (by truncation).
    """
    U, s, _ = np.linalg.svd(X, full_matrices=False)
    # In the basis of the SVD each direction is shrunk by s^2 / (s^2 + lambda) (filter factors:
    # Hansen, "Rank-Deficient and Discrete Ill-Posed Problems", 1998).
    beta = np.sum((U.T @ Y) ** 2, axis=1)
    strength = GRID * s[0] ** 2
    shrink = s**2 / (s**2 + strength[:, None])
    # What lies outside the range of X; rounding may leave it below zero.
    floor = max(float(np.sum(Y**2) - beta.sum()), 0.0) + unexplained
    residual = floor + (1 - shrink) ** 2 @ beta
    scaled = np.divide(beta, s**2, out=np.zeros_like(s), where=s > 0)
    return RidgePath(strength, residual, shrink**2 @ scaled, shrink.sum(axis=1))


def generalised_cross_validation(path: RidgePath, observations: int) -> float:
    """Return the strength that predicts a left-out observation best (Golub et al. 1979).

    Parameters
    ----------
    path
        Solutions along the grid.
    observations
        Number of rows that the problem had before it was compressed.
    """
    # The trace of the influence matrix is the freedom; constant factors do not move the minimum.
    score = path.residual / (observations - path.freedom) ** 2
    return float(path.strength[np.argmin(score)])


def l_curve(path: RidgePath) -> float:
    """Return the strength at the corner of log residual against log size (Hansen 1992)."""
    tiny = np.finfo(float).tiny
    # Half the logarithm of a square is that of the norm, which the L-curve is drawn over.
    x = np.log(np.maximum(path.residual, tiny)) / 2
    y = np.log(np.maximum(path.size, tiny)) / 2
    dx, dy = np.gradient(x), np.gradient(y)
    speed = np.maximum(np.hypot(dx, dy), np.finfo(float).eps)
    curvature = (dx * np.gradient(dy) - dy * np.gradient(dx)) / speed**3
    # Where neither end of the curve moves any more, its direction is rounding.
    curvature[np.hypot(dx, dy) < 1e-6] = -np.inf
    return float(path.strength[np.argmax(curvature)])


class Method(StrEnum):
    """A closed form for C and H."""

    OLS = "ols"
    TLS = "tls"
    RRTLS = "rrtls"
    W_RRTLS = "w_rrtls"


class Weighting(StrEnum):
    """What a reading's weight is made of."""

    LIKELIHOOD = "likelihood"
    PAPER = "paper"


class RidgeRule(StrEnum):
    """How the strength of the ridge is chosen."""

    FIXED = "fixed"
    GCV = "gcv"
    L_CURVE = "l_curve"


class ClosedFormOptions(Options):
    """Which closed form solves for the distortion."""

    method: Method = Method.W_RRTLS
    """`ols`, `tls`, `rrtls` (ridge, truncated) or `w_rrtls` (weighted as well)."""
    weighting: Weighting = Weighting.LIKELIHOOD
    """`likelihood`: 1 / (map variance + sensor variance); `paper`: map variance to the power -2,
    as the published norm amounts to."""
    ridge: RidgeRule = RidgeRule.FIXED
    """`fixed` (at `ridge_strength`), `gcv` or `l_curve`."""
    ridge_strength: float = Field(default=1e-9, ge=0)
    """Fixed ridge relative to the spread of the field. The default only stops directions that the
    data leave open from running away; it moves C by some billionths."""


@dataclass(frozen=True)
class DistortionFit:
    """A distortion and the ridge that shaped it.

    Attributes
    ----------
    distortion
        C without unit, shape (3, 3), and H in uT, shape (3,), lidar to sensor.
    ridge
        Strength relative to the spread of the field (`ridge_unit`); 0 where the method has none.
    """

    distortion: Distortion
    ridge: float


def row_weights(
    map_variance: FloatArray, sensor_variance: float, weighting: Weighting
) -> FloatArray:
    """Return the weight of each reading's squared residual.

    Parameters
    ----------
    map_variance
        Mean variance of the map's prediction over the three axes in uT^2, shape (N,).
    sensor_variance
        Variance of the sensor's noise in uT^2.
    weighting
        `LIKELIHOOD` or `PAPER` (infinite weights of an exact map become equal ones).
    """
    match weighting:
        case Weighting.LIKELIHOOD:
            return 1.0 / (map_variance + sensor_variance)
        case Weighting.PAPER:
            # An exact map has variance zero; the floor keeps its weights finite and equal.
            floor = np.finfo(float).eps * max(float(map_variance.max(initial=0.0)), 1.0)
            return 1.0 / np.maximum(map_variance, floor) ** 2
        case _:
            assert_never(weighting)


def fit_distortion(
    b_lidar: FloatArray, b_meas: FloatArray, weights: FloatArray, options: ClosedFormOptions
) -> DistortionFit:
    """Solve ``b_meas = C b_lidar + H``.

    Parameters
    ----------
    b_lidar
        Field in the lidar frame that the map predicts, uT, shape (N, 3).
    b_meas
        Readings in uT, shape (N, 3).
    weights
        Weight of each reading's squared residual, shape (N,); used by `w_rrtls` only.
    options
        Method, weighting and ridge.

    Raises
    ------
    CalibrationError
        Fewer than four readings: C and H cannot follow from them.
    """
    if len(b_lidar) < MIN_READINGS:
        msg = (
            f"{len(b_lidar)} readings cannot determine a distortion, "
            f"at least {MIN_READINGS} are needed"
        )
        raise CalibrationError(msg)
    method = options.method
    w = weights if method is Method.W_RRTLS else np.ones(len(b_lidar))
    # H is the intercept: centring eliminates it exactly, without truncation or ridge (mixed LS-TLS,
    # Van Huffel and Vandewalle, "The Total Least Squares Problem", 1991).
    mean_l, mean_m = np.average(np.stack([b_lidar, b_meas]), axis=1, weights=w)
    rows = np.sqrt(w / w.mean())[:, None] * np.hstack([b_lidar - mean_l, b_meas - mean_m])
    # R has the singular values, right singular vectors and normal equations of all N rows.
    factor = np.asarray(np.linalg.qr(rows, mode="r"))
    kept = factor if method is Method.OLS else _truncated(factor)
    # The unknown is C - I: the ridge and the smallest solution lead to the identity, not to zero.
    X, Y = kept[:, :3], kept[:, 3:] - kept[:, :3]
    ridge = 0.0
    if method in (Method.RRTLS, Method.W_RRTLS):
        ridge = _ridge(X, Y, float(np.sum((factor - kept) ** 2)), len(rows), options)
    C = np.eye(3) + _solve_ridge(X, Y, ridge * _unit(X)).T
    return DistortionFit(Distortion(C, mean_m - C @ mean_l), ridge)


def ridge_unit(b_lidar: FloatArray, weights: FloatArray) -> float:
    """Return the ridge strength that is called 1: the field's weighted spread.

    It is the sum of squares of the centred field, averaged over the axes.

    Parameters
    ----------
    b_lidar
        Field in uT, shape (N, 3).
    weights
        Weight of each reading's squared residual, shape (N,).
    """
    centred = b_lidar - np.average(b_lidar, axis=0, weights=weights)
    return float(np.sum(weights[:, None] * centred**2)) / 3


def _unit(X: FloatArray) -> float:
    return float(np.sum(X**2)) / 3


def _truncated(factor: FloatArray) -> FloatArray:
    """Return the nearest matrix of rank 3."""
    # Eckart and Young 1936. In rank 3 the readings lie in the span of the field, as TLS asks.
    U, s, Vt = np.linalg.svd(factor, full_matrices=False)
    return np.asarray((U[:, :3] * s[:3]) @ Vt[:3])


def _ridge(
    X: FloatArray, Y: FloatArray, removed: float, observations: int, options: ClosedFormOptions
) -> float:
    """Return the relative strength by the rule of the options."""
    unit = _unit(X)
    if options.ridge is RidgeRule.FIXED or unit == 0.0:
        return options.ridge_strength
    path = ridge_path(X, Y, removed)
    if options.ridge is RidgeRule.GCV:
        return generalised_cross_validation(path, observations) / unit
    return l_curve(path) / unit


def _solve_ridge(X: FloatArray, Y: FloatArray, strength: float) -> FloatArray:
    """Return the minimiser of ``||X A - Y||^2 + strength ||A||^2``, smallest where open."""
    # Rows below X instead of X^T X + strength I, which would square the condition number.
    regressors = np.vstack([X, np.sqrt(strength) * np.eye(3)])
    observations = np.vstack([Y, np.zeros((3, 3))])
    return np.asarray(np.linalg.lstsq(regressors, observations, rcond=1e-12)[0])


def refitted(b_lidar: FloatArray, readings: FloatArray) -> float:
    """Return what any C and H leave of readings at fields ``b_lidar``, per axis, rms in uT.

    Both have the shape (N, 3).
    """
    return float(np.sqrt(np.mean(left_by_any(b_lidar, readings) ** 2)))


def left_by_any(b_lidar: FloatArray, readings: FloatArray) -> FloatArray:
    """Return what any C and H leave of readings at fields ``b_lidar`` in uT; all (N, 3)."""
    A: FloatArray = np.column_stack([b_lidar, np.ones(len(b_lidar))])
    # A vehicle that keeps its heading leaves columns alike; least squares takes the shortest then.
    solution = np.linalg.lstsq(A, readings, rcond=None)[0]
    return np.asarray(A @ solution - readings)

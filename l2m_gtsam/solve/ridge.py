"""How strong a ridge should be: two classical answers on one small singular value decomposition.

The problem is ``min ||X A - Y||^2 + lambda ||A||^2``. Both rules look at ``lambda`` on a grid
relative to the largest squared singular value of X, so they do not depend on units.
"""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray

# Times the largest squared singular value: from rounding to a solution of next to nothing, 20 a
# decade.
GRID = np.logspace(-14, 2, 321)


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

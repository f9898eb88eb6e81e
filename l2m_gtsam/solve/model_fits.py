"""Models of a magnetometer's readings fitted by weighted least squares.

One QR of the weighted columns 1, b, q and db/dt serves every model: the rest works on its
triangular factor. All but the one are centred, so that directions without data are seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import matmul_toeplitz
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.sensor_models import ONE_DRIVE, Coefficients, Model, Samples

ROUNDING = 1e-10  # of the largest: directions in which columns vary less follow from rounding
EXACT = 1e-9  # of the readings' spread: what is left of them is never taken to be less
STEPS = 100  # of Gauss-Newton, which takes about five
SMALL_STEP = 1e-10  # in radians and in scale
TOUCHED = 1e-4  # a share of one per cent in length
TURNS = np.array(  # [e]x for the three axes e
    [
        [[0.0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0.0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ]
)


@dataclass(frozen=True)
class Compressed:
    """Everything that the fits ask of N readings, with P columns.

    Attributes
    ----------
    mean
        Weighted means that are taken off b, q and db/dt, shape (P - 1,).
    size
        By which they are divided, so that all vary as the field does, shape (P - 1,).
    Q, R
        Orthonormal columns, shape (N, P), times a triangular factor, shape (P, P): the weighted,
        centred and divided columns, the one first.
    Y
        Weighted readings in the coordinates of Q, shape (P, 3).
    rest
        Weighted sum of squares that no coefficients explain.
    """

    mean: FloatArray
    size: FloatArray
    Q: FloatArray
    R: FloatArray
    Y: FloatArray
    rest: float

    def left(self, A: FloatArray) -> FloatArray:
        """Return what coefficients of the columns, shape (P, 3), leave of Y, shape (P, 3)."""
        return np.asarray(self.Y - self.R @ A)


@dataclass(frozen=True)
class Solution:
    """Coefficients of the columns, and how they move with a model's parameters.

    Attributes
    ----------
    A
        Coefficients of the divided columns in uT, shape (P, 3).
    tangent
        Derivatives by the parameters, shape (M, P, 3).
    """

    A: FloatArray
    tangent: FloatArray


@dataclass(frozen=True)
class Fit:
    """A model's best coefficients and what they leave.

    Attributes
    ----------
    solution
        Coefficients of the centred and divided columns.
    coefficients
        The same for b in uT, q and db/dt in their own units.
    parameters
        Number of those that the readings determine.
    squares
        Weighted sum of squares that is left.
    variance
        Of a weighted residual per axis, without unit: 1 if the weights are right.
    """

    solution: Solution
    coefficients: Coefficients
    parameters: int
    squares: float
    variance: float


@dataclass(frozen=True)
class Spread:
    """How far a fit may be off where residuals are correlated.

    Attributes
    ----------
    sigma
        Standard deviations; infinite for what the readings do not determine, zero for what the
        model fixes.
    freedom
        Number of parameters, each counted as often as the variance of its estimate exceeds that
        with independent residuals.
    """

    sigma: Coefficients
    freedom: float


def compress(samples: Samples) -> Compressed:
    """Return the QR of the weighted columns."""
    X, w = samples.columns(), samples.weights
    mean = np.average(X, axis=0, weights=w)
    centred = X - mean
    spread = np.sqrt(np.average(centred**2, axis=0, weights=w))
    # Centring leaves the rounding of a column that does not vary.
    centred[:, spread <= ROUNDING * np.abs(X).max(axis=0)] = 0.0
    size = _sizes(spread)
    # QR instead of the normal equations, which would square the condition number.
    root = np.sqrt(w)[:, None]
    Q, R = np.linalg.qr(root * np.column_stack([np.ones(len(X)), centred / size]))
    Y = Q.T @ (root * samples.z)
    rest = np.sum((root * samples.z - Q @ Y) ** 2) + EXACT**2 * np.sum(Y[1:] ** 2)
    return Compressed(mean, size, Q, R, Y, float(rest))


def _sizes(spread: FloatArray) -> FloatArray:
    """Return divisors that give columns the spread of the field; b and db/dt keep their shape."""
    field, rate = (np.sqrt(np.mean(part**2)) for part in (spread[:3], spread[-3:]))
    size = np.concatenate([np.full(3, field), spread[3:-3], np.full(3, rate)])
    return np.where(size > 0, size, 1.0) / (field if field > 0 else 1.0)


def fit_model(model: Model, compressed: Compressed) -> Fit:
    """Fit a model by weighted least squares; what is not determined stays at a pure rotation."""
    match model:
        case Model.OFFSET:
            solution = _rotated(compressed)
        case Model.SCALE:
            solution = _scaled(compressed)
        case _:
            solution = _linear(model, compressed)
    s = np.linalg.svd(_jacobian(solution, compressed), compute_uv=False)
    parameters = int(np.sum(s > ROUNDING * s[0]))
    squares = float(np.sum(compressed.left(solution.A) ** 2)) + compressed.rest
    X = solution.A[1:] / compressed.size[:, None]
    coefficients = Coefficients.of_columns(X, solution.A[0] - compressed.mean @ X)
    variance = squares / (3 * len(compressed.Q) - parameters)
    return Fit(solution, coefficients, parameters, squares, variance)


def _jacobian(solution: Solution, compressed: Compressed) -> FloatArray:
    """Return the derivatives of what is explained of Y, row by row, shape (3 P, M)."""
    by_parameter = compressed.R @ solution.tangent
    return np.asarray(by_parameter.reshape(len(by_parameter), -1).T)


def _linear(model: Model, compressed: Compressed) -> Solution:
    """Return the least squares of the columns that a model has."""
    P = len(compressed.R)
    used = np.ones(P, dtype=np.bool_)
    used[4:-3], used[-3:] = model.has_regressors, model.has_eddy
    # Steps from the rotation: the smallest step leaves directions without data there.
    A = _rotated(compressed).A
    A[used] += np.linalg.lstsq(compressed.R[:, used], compressed.left(A), rcond=ROUNDING)[0]
    tangent = np.eye(3 * P).reshape(P, 3, P, 3)[used]
    return Solution(A, tangent.reshape(-1, P, 3))


@dataclass(frozen=True)
class ScaledRotation:
    """C = diag(scale) rotation, shapes (3,) and (3, 3)."""

    scale: FloatArray
    rotation: FloatArray

    @property
    def C(self) -> FloatArray:
        """The product, shape (3, 3)."""
        return self.scale[:, None] * self.rotation

    def moved(self, step: FloatArray) -> "ScaledRotation":
        """Return it turned by the first three of six numbers, its scales changed by the others."""
        # On the rotation's left, as ``derivatives`` takes it: d exp([w]x) R / dw = [e]x R at w = 0.
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return ScaledRotation(self.scale + step[3:], turn @ self.rotation)

    def derivatives(self) -> FloatArray:
        """Return those of C by the six numbers, shape (6, 3, 3)."""
        by_turn = self.scale[:, None] * (TURNS @ self.rotation)
        return np.concatenate([by_turn, np.eye(3)[:, :, None] * self.rotation])


def _restricted(C: FloatArray, derivatives: FloatArray, compressed: Compressed) -> Solution:
    """Return C with its best offset; derivatives of C by M parameters have the shape (M, 3, 3)."""
    M, P = len(derivatives), len(compressed.R)
    A, tangent = np.zeros((P, 3)), np.zeros((3 + M, P, 3))
    A[1:4], tangent[3:, 1:4] = C.T, derivatives.transpose(0, 2, 1)
    # The other columns are centred: their share in the first row is rounding.
    A[0], tangent[:3, 0] = compressed.left(A)[0] / compressed.R[0, 0], np.eye(3)
    return Solution(A, tangent)


def _rotated(compressed: Compressed) -> Solution:
    """Return the best rotation in closed form."""
    rotation = _nearest_rotation(compressed, mirror=1.0)
    return _restricted(rotation, TURNS @ rotation, compressed)


def _nearest_rotation(compressed: Compressed, mirror: float) -> FloatArray:
    """Return the rotation that, times 1 or -1, explains most (W. Kabsch 1976)."""
    # Orthogonal Procrustes problem: the rotation nearest in least squares (Schoenemann,
    # Psychometrika 31:1, 1966), with det = 1 (Kabsch, Acta Crystallographica A32:922, 1976).
    U, _, Vt = np.linalg.svd(mirror * compressed.Y[1:4].T @ compressed.R[1:4, 1:4])
    # The direction of the least singular value costs least to flip where det would be -1.
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    return np.asarray(U @ Vt)


def _scaled(compressed: Compressed) -> Solution:
    """Return the best rotation and scale of each axis of the sensor, by Gauss-Newton.

    A step is halved until it does not make things worse; the end is a step below 1e-10 radians
    and parts of the scale. Where the free C mirrors, so do the scales.
    """
    field, Y = compressed.R[1:4, 1:4], compressed.Y[1:4]
    mirror = -1.0 if np.linalg.det(_linear(Model.FULL, compressed).A[1:4]) < 0 else 1.0
    state = ScaledRotation(np.full(3, mirror), _nearest_rotation(compressed, mirror))
    for _ in range(STEPS):
        left = Y - field @ state.C.T
        J = (field @ state.derivatives().transpose(0, 2, 1)).reshape(6, 9).T
        step = np.asarray(np.linalg.lstsq(J, left.ravel(), rcond=ROUNDING)[0], dtype=float)
        trial = state.moved(step)
        while np.abs(step).max() > SMALL_STEP and (
            np.sum((Y - field @ trial.C.T) ** 2) > np.sum(left**2)
        ):
            step = step / 2
            trial = state.moved(step)
        if np.abs(step).max() <= SMALL_STEP:
            break
        state = trial
    return _restricted(state.C, state.derivatives(), compressed)


def inflation(
    compressed: Compressed, correlation: FloatArray, drives: Sequence[slice] = ONE_DRIVE
) -> FloatArray:
    r"""Return a root of the covariance inflation by correlated residuals, shape (P, P).

    Residuals with the correlation matrix :math:`\rho` have a covariance :math:`Q^T \rho Q` along
    the columns Q instead of I. Where it is less than that it counts as I.

    Parameters
    ----------
    compressed
        QR of the N x P columns.
    correlation
        Of weighted residuals no, one, two, ... readings apart, shape (N,).
    drives
        Rows of each drive: residuals of two drives are independent.
    """
    # Toeplitz products by FFT: N log N, without an N x N matrix.
    parts = [compressed.Q[rows] for rows in drives]
    along = np.sum([Q.T @ matmul_toeplitz(correlation[: len(Q)], Q) for Q in parts], axis=0)
    value, vector = np.linalg.eigh(along)
    return np.asarray(np.sqrt(np.maximum(value, 1.0))[:, None] * vector.T)


def spread_of(fit: Fit, compressed: Compressed, root: FloatArray) -> Spread:
    """Return the sigmas of a fit in closed form, for residuals of this ``inflation``.

    They are those of ordinary least squares under a covariance that it does not know (H. White
    1980): the weights stay those of the readings.
    """
    # Sandwich J^+ S J^+T with J^+ = V s^-1 U^T and S = root^T root along the columns.
    J, P = _jacobian(fit.solution, compressed), len(root)
    U, s, Vt = np.linalg.svd(J, full_matrices=False)
    strong = s > ROUNDING * s[0]
    spread = np.tensordot(root, U[:, strong].reshape(P, 3, -1), axes=1).reshape(3 * P, -1)
    steps = np.sqrt(fit.variance) * (spread / s[strong]) @ Vt[strong]
    by_X = fit.solution.tangent[:, 1:] / compressed.size[:, None]
    by_H = fit.solution.tangent[:, 0] - compressed.mean @ by_X
    sigma = (_sigma(by, steps, Vt[~strong]) for by in (by_X, by_H))
    return Spread(Coefficients.of_columns(*sigma), float(np.sum(spread**2)))


def _sigma(by: FloatArray, steps: FloatArray, unknown: FloatArray) -> FloatArray:
    """Return standard deviations of what M parameters determine.

    Parameters
    ----------
    by
        Derivatives by the parameters, shape (M, ...).
    steps
        A root of their covariance, shape (L, M).
    unknown
        Directions without any information, of unit length, shape (U, M).
    """
    sigma = np.sqrt(np.sum(np.tensordot(steps, by, axes=1) ** 2, axis=0))
    touched = np.sum(np.tensordot(unknown, by, axes=1) ** 2, axis=0)
    return np.where(touched > TOUCHED * np.sum(by**2, axis=0), np.inf, sigma)

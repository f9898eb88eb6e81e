r"""Solving the linear graph of sensors and map weights, block by block.

Each sensor's sixteen parameters are eliminated by QR ``X = Q R`` of the rows ``X x + E beta = b``
that touch it, which does not mind directions of very different strength. What remains speaks of
the shared weights alone, those of the map's error and of the poses'; their prior has unit variance,
so that a Cholesky factor of their information is safe:

.. math::
    R_s \delta_s + S_s \beta = d_s, \quad S_s = Q_s^T E_s, \quad
    \Lambda = \Lambda_0 + \sum_s (E_s^T E_s - S_s^T S_s), \quad
    \mathrm{cov}(\delta_s) = R_s^{-1} (I + S_s \Lambda^{-1} S_s^T) R_s^{-T}

A reading touches the weights of one tile and two knots, so that ``E^T E`` is made of small blocks.
GTSAM's own sequential QR gives the same, but fills in and knows nothing of BLAS: it is far slower.
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from l2m_factors import D, S, T
from l2m_gtsam.data import FloatArray, IntArray

SENSOR = 16  # parameters of a sensor: t, C row by row, H, time offset
PLACES = {T: slice(0, 3), D: slice(3, 15), S: slice(15, 16)}
NONE = np.empty(0, dtype=np.int64)


@dataclass(frozen=True)
class Block:
    """A square block of an information matrix: which weights it is of, (r,), and itself, (r, r)."""

    columns: IntArray
    information: FloatArray


@dataclass(frozen=True)
class SensorRows:
    """Conditional of one sensor given the shared weights: ``R x + S beta = d``.

    Attributes
    ----------
    R, S, d
        Shapes (16, 16), (16, K) and (16,).
    weights
        ``E^T E``: what its readings would say of the weights if its parameters were known.
    """

    R: FloatArray
    S: FloatArray
    d: FloatArray
    weights: tuple[Block, ...]


@dataclass(frozen=True)
class Eliminated:
    """A linear graph solved.

    Attributes
    ----------
    sensors
        Conditional of each sensor.
    factor
        Cholesky factor of the information of the shared weights, lower triangular, shape (K, K).
    beta
        Their step, shape (K,).
    """

    sensors: dict[int, SensorRows]
    factor: FloatArray
    beta: FloatArray

    def covariance(self, sensor: int) -> FloatArray:
        """Return the marginal covariance of (t, C row by row, H, offset), shape (16, 16)."""
        R = self.sensors[sensor].R
        return np.asarray(solve_triangular(R, solve_triangular(R, self._spread(sensor)).T))

    def step(self, sensor: int) -> FloatArray:
        """Return the step of a sensor's parameters, shape (16,)."""
        rows = self.sensors[sensor]
        return np.asarray(solve_triangular(rows.R, rows.d - rows.S @ self.beta))

    def sigmas(self, sensor: int) -> float:
        """Return the length of a sensor's step in standard deviations."""
        along = self.sensors[sensor].R @ self.step(sensor)
        return float(np.sqrt(along @ np.linalg.solve(self._spread(sensor), along)))

    @cached_property
    def covariance_of_weights(self) -> FloatArray:
        """Covariance of the shared weights, shape (K, K)."""
        return np.asarray(cho_solve((self.factor, True), np.eye(len(self.factor))))

    def taken(self, sensor: int) -> float:
        """Return the degrees of freedom of a sensor's readings that went into the weights.

        The trace of what they say of the weights times the weights' covariance: as many as there
        are weights that no prior and no other sensor tells.
        """
        covariance, rows = self.covariance_of_weights, self.sensors[sensor]
        alone = sum(
            float(np.sum(covariance[np.ix_(block.columns, block.columns)] * block.information))
            for block in rows.weights
        )
        return alone - float(np.trace(self._spread(sensor)) - SENSOR)

    def _spread(self, sensor: int) -> FloatArray:
        """Return ``I + S Lambda^-1 S^T``: the covariance of ``R x``, shape (16, 16)."""
        S = self.sensors[sensor].S
        half = solve_triangular(self.factor, S.T, lower=True, check_finite=False)
        return np.asarray(np.eye(SENSOR) + half.T @ half)

    def stepped(self, values: gtsam.Values, sizes: dict[int, int]) -> gtsam.Values:
        """Return values moved by the step; ``sizes`` are those of the shared weights, by key."""
        delta = gtsam.VectorValues()
        for sensor in self.sensors:
            step = self.step(sensor)
            for variable, at in PLACES.items():
                delta.insert(variable(sensor), step[at])
        for key, columns in weight_columns(sizes).items():
            delta.insert(key, self.beta[columns])
        return values.retract(delta)


@dataclass(frozen=True)
class Rows:
    """Rows of a linear graph: ``X x + E beta[columns] = b`` for one sensor, or none.

    Attributes
    ----------
    X, E, b
        Shapes (J, 16), (J, r) and (J,).
    columns
        Which of all weights, shape (r,).
    """

    X: FloatArray
    E: FloatArray
    b: FloatArray
    columns: IntArray

    def fewer(self) -> "Rows":
        """Return rows of the same ``|X x + E beta - b|^2``, one more than columns at most."""
        width = SENSOR + self.E.shape[1]
        if len(self.b) <= width + 1:
            return self
        R = np.linalg.qr(np.column_stack([self.X, self.E, self.b]), mode="r")
        X, E, b = np.split(R, [SENSOR, width], axis=1)
        return Rows(X, E, b.ravel(), self.columns)

    @cached_property
    def block(self) -> Block:
        """What the rows would say of the weights if the sensor's parameters were known."""
        return Block(self.columns, self.E.T @ self.E)


def eliminate(
    linear: gtsam.GaussianFactorGraph, sensors: list[int], sizes: dict[int, int]
) -> Eliminated:
    """Solve a linear graph whose factors touch at most one sensor each.

    Parameters
    ----------
    linear
        Factors on ``T(i)``, ``D(i)``, ``S(i)`` and shared weights.
    sensors
        Sensors of the graph.
    sizes
        Number of shared weights of each key.
    """
    grouped, count = rows_by_sensor(linear, sensors, sizes), sum(sizes.values())
    information, pull = np.zeros((count, count)), np.zeros(count)
    conditionals = {s: conditional(rows, count) for s, rows in grouped.items() if s in sensors}
    for rows in (each for group in grouped.values() for each in group):
        information[np.ix_(rows.columns, rows.columns)] += rows.block.information
        pull[rows.columns] += rows.E.T @ rows.b
    for sensor in conditionals.values():
        information -= sensor.S.T @ sensor.S
        pull -= sensor.S.T @ sensor.d
    factor = cholesky(information, lower=True, overwrite_a=True, check_finite=False)
    return Eliminated(conditionals, factor, cho_solve((factor, True), pull))


def conditional(rows: list[Rows], count: int) -> SensorRows:
    """Return a sensor's conditional given all ``count`` weights."""
    Q, R = np.linalg.qr(np.concatenate([each.X for each in rows]))
    S, start = np.zeros((len(R), count)), 0
    for each in rows:
        S[:, each.columns] += Q[start : start + len(each.X)].T @ each.E
        start += len(each.X)
    d = Q.T @ np.concatenate([each.b for each in rows])
    return SensorRows(R, S, d, tuple(each.block for each in rows))


def rows_by_sensor(
    linear: gtsam.GaussianFactorGraph, sensors: list[int], sizes: dict[int, int]
) -> dict[int, list[Rows]]:
    """Return the rows of each sensor, and under -1 those of the weights alone."""
    place = {key(s): (s, at) for key, at in PLACES.items() for s in sensors}
    columns_of = weight_columns(sizes).items()
    weights = {key: np.arange(at.start, at.stop) for key, at in columns_of}
    found: dict[int, list[Rows]] = {sensor: [] for sensor in [*sensors, -1]}
    for index in range(linear.size()):
        factor, sensor, start = linear.at(index), -1, 0
        jacobian, b = factor.jacobian()
        X, E, columns = np.zeros((len(b), SENSOR)), [np.empty((len(b), 0))], [NONE]
        for key in list(factor.keys()):
            if key in weights:
                width = len(weights[key])
                E.append(jacobian[:, start : start + width])
                columns.append(weights[key])
            else:
                sensor, at = place[key]
                width = at.stop - at.start
                X[:, at] = jacobian[:, start : start + width]
            start += width
        found[sensor].append(Rows(X, np.hstack(E), b, np.concatenate(columns)).fewer())
    return found


def weight_columns(sizes: dict[int, int]) -> dict[int, slice]:
    """Return the columns of each key's weights among all of them."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {
        key: slice(end - size, end) for (key, size), end in zip(sizes.items(), ends, strict=True)
    }

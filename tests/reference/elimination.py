r"""Solving the linear graph of sensors and map weights, block by block.

The sixteen parameters of a sensor, or those of a cluster of sensors that factors connect, are
eliminated by QR ``X = Q R`` of the rows ``X x + E beta = b`` that touch them, which does not mind
directions of very different strength. What remains speaks of the shared weights alone, those of the
map's error and of the poses'; their prior has unit variance, so that a Cholesky factor of their
information is safe:

.. math::
    R_c \delta_c + S_c \beta = d_c, \quad S_c = Q_c^T E_c, \quad
    \Lambda = \Lambda_0 + \sum_c (E_c^T E_c - S_c^T S_c), \quad
    \mathrm{cov}(\delta_c) = R_c^{-1} (I + S_c \Lambda^{-1} S_c^T) R_c^{-T}

A reading touches the weights of one tile and two knots, so that ``E^T E`` is made of small blocks.
This was the engine of the last graph before GTSAM became it; here it is the slow reference.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from l2m_gtsam.calibration.optimise import clusters_of
from l2m_gtsam.calibration.sensor_columns import SENSOR, columns_among, columns_of, rows_in
from l2m_gtsam.data import FloatArray, IntArray

NONE = np.empty(0, dtype=np.int64)
SHARED = -1  # of rows that are no one sensor's


@dataclass(frozen=True)
class Block:
    """A square block of an information matrix: which weights it is of, (r,), and itself, (r, r)."""

    columns: IntArray
    information: FloatArray


@dataclass(frozen=True)
class Share:
    """What the rows of one sensor ``A x' + E beta`` are to a cluster, with ``x' = R x``.

    Attributes
    ----------
    gram
        ``A^T A``, shape (16 n, 16 n).
    S
        ``A^T E``, shape (16 n, K).
    weights
        ``E^T E``: what its readings would say of the weights if its parameters were known.
    """

    gram: FloatArray
    S: FloatArray
    weights: tuple[Block, ...]


@dataclass(frozen=True)
class ClusterRows:
    """Conditional of n connected sensors given the shared weights: ``R x + S beta = d``.

    Attributes
    ----------
    sensors
        Which, in order.
    R, S, d
        Shapes (16 n, 16 n), (16 n, K) and (16 n,).
    shares
        What came from the rows of each sensor alone, and under SHARED from all others.
    """

    sensors: tuple[int, ...]
    R: FloatArray
    S: FloatArray
    d: FloatArray
    shares: dict[int, Share]


@dataclass(frozen=True)
class Eliminated:
    """A linear graph solved.

    Attributes
    ----------
    clusters
        Conditional of each cluster of sensors.
    factor
        Cholesky factor of the information of the shared weights, lower triangular, shape (K, K).
    beta
        Their step, shape (K,).
    """

    clusters: tuple[ClusterRows, ...]
    factor: FloatArray
    beta: FloatArray

    def covariance(self, sensor: int) -> FloatArray:
        """Return the marginal covariance of (t, C row by row, H, offset), shape (16, 16)."""
        return self.among((sensor,))

    def among(self, sensors: tuple[int, ...]) -> FloatArray:
        """Return the covariance of all parameters of sensors of one cluster, (16 n, 16 n)."""
        cluster = self._of[sensors[0]]
        R, at = cluster.R, columns_among(cluster.sensors, sensors)
        whole = solve_triangular(R, solve_triangular(R, self._spread(cluster)).T)
        return np.asarray(whole[np.ix_(at, at)])

    def shared_root(self, sensor: int) -> FloatArray:
        """Return a root of what shared weights contribute to a sensor's covariance, (16, K).

        Sensors of different clusters have the covariance ``root_a @ root_b.T`` in common.
        """
        cluster = self._of[sensor]
        root = solve_triangular(cluster.R, self._half(cluster.S).T)
        return np.asarray(root[rows_in(cluster.sensors, sensor)])

    def step(self, sensor: int) -> FloatArray:
        """Return the step of a sensor's parameters, shape (16,)."""
        cluster = self._of[sensor]
        step = solve_triangular(cluster.R, cluster.d - cluster.S @ self.beta)
        return np.asarray(step[rows_in(cluster.sensors, sensor)])

    def sigmas(self, sensor: int) -> float:
        """Return the length of a sensor's step in standard deviations."""
        cluster = self._of[sensor]
        inverse = solve_triangular(cluster.R, np.eye(len(cluster.R)))
        own = inverse[rows_in(cluster.sensors, sensor)]
        root = np.linalg.qr(cholesky(self._spread(cluster)) @ own.T, mode="r")
        return float(np.linalg.norm(solve_triangular(root, self.step(sensor), trans="T")))

    @cached_property
    def covariance_of_weights(self) -> FloatArray:
        """Covariance of the shared weights, shape (K, K)."""
        return np.asarray(cho_solve((self.factor, True), np.eye(len(self.factor))))

    def taken(self, sensor: int) -> float:
        """Return the degrees of freedom that the rows of a sensor take beside its own sixteen.

        The trace of their part of the hat matrix: as many as there are weights that no prior and
        no other sensor tells, and less of its own where other sensors tell them.
        """
        covariance, cluster = self.covariance_of_weights, self._of[sensor]
        share = cluster.shares[sensor]
        alone = sum(
            float(np.sum(covariance[np.ix_(block.columns, block.columns)] * block.information))
            for block in share.weights
        )
        half, own = self._half(cluster.S), self._half(share.S)
        through = float(np.sum((half @ share.gram - 2 * own) * half))
        return float(np.trace(share.gram)) - SENSOR + alone + through

    @cached_property
    def _of(self) -> dict[int, ClusterRows]:
        return {sensor: cluster for cluster in self.clusters for sensor in cluster.sensors}

    def _half(self, S: FloatArray) -> FloatArray:
        return np.asarray(solve_triangular(self.factor, S.T, lower=True, check_finite=False))

    def _spread(self, cluster: ClusterRows) -> FloatArray:
        """Return ``I + S Lambda^-1 S^T``: the covariance of ``R x``, shape (16 n, 16 n)."""
        half = self._half(cluster.S)
        return np.asarray(np.eye(len(cluster.R)) + half.T @ half)

    def stepped(self, values: gtsam.Values, sizes: dict[int, int]) -> gtsam.Values:
        """Return values moved by the step; ``sizes`` are those of the shared weights, by key."""
        delta = gtsam.VectorValues()
        for cluster in self.clusters:
            step = solve_triangular(cluster.R, cluster.d - cluster.S @ self.beta)
            for key, at in columns_of(cluster.sensors).items():
                delta.insert(key, step[at])
        for key, columns in weight_columns(sizes).items():
            delta.insert(key, self.beta[columns])
        return values.retract(delta)


@dataclass(frozen=True)
class Rows:
    """Rows of a linear graph: ``X x + E beta[columns] = b`` for one cluster, or none.

    Attributes
    ----------
    X, E, b
        Shapes (J, 16 n), (J, r) and (J,).
    columns
        Which of all weights, shape (r,).
    sensor
        Whose they are; SHARED if no one's alone.
    """

    X: FloatArray
    E: FloatArray
    b: FloatArray
    columns: IntArray
    sensor: int = SHARED

    def fewer(self) -> "Rows":
        """Return rows of the same ``|X x + E beta - b|^2``, one more than columns at most."""
        touched = np.flatnonzero(self.X.any(axis=0))
        width = len(touched) + self.E.shape[1]
        if len(self.b) <= width + 1:
            return self
        joined = np.column_stack([self.X[:, touched], self.E, self.b])
        own, E, b = np.split(np.linalg.qr(joined, mode="r"), [len(touched), width], axis=1)
        X = np.zeros((len(b), self.X.shape[1]))
        X[:, touched] = own
        return replace(self, X=X, E=E, b=b.ravel())

    @cached_property
    def block(self) -> Block:
        """What the rows would say of the weights if the sensors' parameters were known."""
        return Block(self.columns, self.E.T @ self.E)


def eliminate(
    linear: gtsam.GaussianFactorGraph, sensors: list[int], sizes: dict[int, int]
) -> Eliminated:
    """Solve a linear graph.

    Parameters
    ----------
    linear
        Factors on ``T(i)``, ``D(i)``, ``S(i)`` and shared weights.
    sensors
        Sensors of the graph.
    sizes
        Number of shared weights of each key.
    """
    clusters = clusters_of(linear, sensors)
    grouped, count = rows_by_cluster(linear, clusters, sizes), sum(sizes.values())
    information, pull = np.zeros((count, count)), np.zeros(count)
    conditionals = tuple(conditional(each, grouped[each], count) for each in clusters)
    for rows in (each for group in grouped.values() for each in group):
        information[np.ix_(rows.columns, rows.columns)] += rows.block.information
        pull[rows.columns] += rows.E.T @ rows.b
    for cluster in conditionals:
        information -= cluster.S.T @ cluster.S
        pull -= cluster.S.T @ cluster.d
    factor = cholesky(information, lower=True, overwrite_a=True, check_finite=False)
    return Eliminated(conditionals, factor, cho_solve((factor, True), pull))


def conditional(cluster: tuple[int, ...], rows: list[Rows], count: int) -> ClusterRows:
    """Return a cluster's conditional given all ``count`` weights."""
    Q, R = np.linalg.qr(np.concatenate([each.X for each in rows]))
    parts = np.split(Q, np.cumsum([len(each.X) for each in rows])[:-1])
    pairs = list(zip(parts, rows, strict=True))
    shares = {
        sensor: share_of([pair for pair in pairs if pair[1].sensor == sensor], len(R), count)
        for sensor in (*cluster, SHARED)
    }
    S = sum((share.S for share in shares.values()), np.zeros((len(R), count)))
    d = Q.T @ np.concatenate([each.b for each in rows])
    return ClusterRows(cluster, R, S, d, shares)


def share_of(pairs: list[tuple[FloatArray, Rows]], width: int, count: int) -> Share:
    """Return what rows, each beside its part of Q, are to their cluster."""
    gram, S = np.zeros((width, width)), np.zeros((width, count))
    for A, rows in pairs:
        gram += A.T @ A
        S[:, rows.columns] += A.T @ rows.E
    return Share(gram, S, tuple(rows.block for _, rows in pairs))


def rows_by_cluster(
    linear: gtsam.GaussianFactorGraph, clusters: list[tuple[int, ...]], sizes: dict[int, int]
) -> dict[tuple[int, ...], list[Rows]]:
    """Return the rows of each cluster, and under no sensor those of the weights alone."""
    places = {key: (each, at) for each in clusters for key, at in columns_of(each).items()}
    weights = {key: np.arange(at.start, at.stop) for key, at in weight_columns(sizes).items()}
    found: dict[tuple[int, ...], list[Rows]] = {cluster: [] for cluster in [*clusters, ()]}
    for index in range(linear.size()):
        factor = linear.at(index)
        keys = list(factor.keys())
        cluster = next((places[key][0] for key in keys if key in places), ())
        own = {key: places[key][1] for key in keys if key in places}
        found[cluster].append(rows_of(factor, cluster, own, weights).fewer())
    return found


def rows_of(
    factor: gtsam.GaussianFactor,
    cluster: tuple[int, ...],
    own: dict[int, slice],
    weights: dict[int, IntArray],
) -> Rows:
    """Return the rows of a factor; ``own`` says where a sensor's key stands in its cluster."""
    jacobian, b = factor.jacobian()
    X, E, columns = np.zeros((len(b), SENSOR * len(cluster))), [np.empty((len(b), 0))], [NONE]
    start = 0
    for key in list(factor.keys()):
        if key in own:
            width = own[key].stop - own[key].start
            X[:, own[key]] = jacobian[:, start : start + width]
        else:
            width = len(weights[key])
            E.append(jacobian[:, start : start + width])
            columns.append(weights[key])
        start += width
    named = {cluster[at.start // SENSOR] for at in own.values()}
    sensor = named.pop() if len(named) == 1 else SHARED
    return Rows(X, np.hstack(E), b, np.concatenate(columns), sensor)


def weight_columns(sizes: dict[int, int]) -> dict[int, slice]:
    """Return the columns of each key's weights among all of them."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {
        key: slice(end - size, end) for (key, size), end in zip(sizes.items(), ends, strict=True)
    }

r"""All variables of the last graph together: what marginals of a few of them do not give.

How many degrees of freedom the fit takes of a sensor's readings is a trace over the hat matrix,

.. math::
    \mathrm{tr}(J_s \Sigma J_s^T) = \sum_g \mathrm{tr}(J_g \Sigma_{gg} J_g^T)

and needs the covariances of each group of readings' variables: of all sensors, weights and knots.
GTSAM's ``jointMarginalCovariance`` of all of them takes ten times as long as LAPACK's inverse of
the same matrix (2,663 variables: 7.2 s and 0.6 s). The Newton step that remains comes with it, and
is taken where it is short.

Columns are scaled to unit information: sigmas of metres, microtesla and seconds are then alike,
and Cholesky factors what GTSAM's test of neighbouring pivots refuses; QR does the rest.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky

from l2m_gtsam.calibration.sensor_columns import SENSOR, keys_of
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.solve.linear_algebra import add_upper, inverse_of_factor, submatrix

SHARED = -1  # of rows that are no one sensor's
NO_READINGS = np.empty(0, dtype=np.int64)
ROUNDING = 1e-14  # of the largest pivot: a smaller one is nothing


@dataclass(frozen=True)
class Rows:
    """White rows ``J x + e`` of a linear system.

    Attributes
    ----------
    sensor
        Whose they are; SHARED if no one's alone.
    columns
        Which of all variables they touch, shape (k,).
    jacobian, residual
        J, shape (m, k), and e, shape (m,).
    readings
        Of the view that they are of, three rows each, shape (m / 3,); none for a prior.
    """

    sensor: int
    columns: IntArray
    jacobian: FloatArray
    residual: FloatArray
    readings: IntArray


def blocks(covariance: FloatArray, J: FloatArray, size: int) -> FloatArray:
    """Return the blocks of ``J Sigma J^T`` about its diagonal, shape (m / size, size, size).

    Of a covariance Sigma, shape (k, k), and J, shape (m, k).
    """
    shape = (-1, size, len(covariance))
    return (J @ covariance).reshape(shape) @ J.reshape(shape).transpose(0, 2, 1)


def leverage(every: FloatArray, rows: Rows, whitening: FloatArray) -> FloatArray:
    """Return the share of each reading's variance that a fit takes of its residual, shape (n,).

    Of the residual as it is: a white one mixes readings whose poses' errors have much in common,
    and a reading at a knot of these is fitted far closer than one between two.

    Parameters
    ----------
    every
        Covariance of all N variables, shape (N, N).
    rows
        White rows of n readings.
    whitening
        What made them white, (n, 3, 3), or lower triangular (3 n, 3 n).
    """
    size = whitening.shape[-1]
    # What made white, undone: a root of each block's covariance.
    root = np.linalg.solve(whitening.reshape(-1, size, size), np.eye(size))
    taken = blocks(submatrix(every, rows.columns), rows.jacobian, size)
    # Products of matrices: einsum plans anew how to contract each of a thousand groups.
    fitted = ((root @ taken) * root).sum(axis=2)
    whole = (root**2).sum(axis=2)
    return np.asarray(fitted.reshape(-1, 3).sum(axis=1) / whole.reshape(-1, 3).sum(axis=1))


@dataclass(frozen=True)
class JointInformation:
    """A linear system solved.

    Attributes
    ----------
    columns
        Where each key's variables stand among all n.
    rows
        What it is made of beside the prior of the weights.
    every
        Covariance of all variables, shape (n, n).
    step
        To the least cost, shape (n,).
    decrement
        How long that is for all variables together, in standard deviations.
    loose
        What the covariance of all variables has beyond that of the system, a root, shape (n, k).
    """

    columns: Mapping[int, slice]
    rows: Sequence[Rows]
    every: FloatArray
    step: FloatArray
    decrement: float
    loose: FloatArray

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Return the covariance of the k variables of some keys, in their order, shape (k, k)."""
        return submatrix(self.every, columns_at(self.columns, keys))

    def loosened(self, key: int, spread: FloatArray) -> "JointInformation":
        """Return the same where unit variables of a key have these standard deviations in truth.

        A deviation of one is as far as the system is linear. What the readings say of such a
        variable, the information beyond its prior's, stays as it is; its covariance with all others
        grows with its own.
        """
        every, added = self.every, [self.loose]
        for variable, deviation in zip(columns_at(self.columns, [key]), spread, strict=True):
            if deviation <= 1:
                continue
            column = every[:, variable]
            said = max(1 / column[variable] - 1, 0.0)
            grown = 1 / (1 / deviation**2 + said)
            column = column * (np.sqrt(grown - column[variable]) / column[variable])
            every = every + np.outer(column, column)
            added.append(column[:, None])
        return replace(self, every=every, loose=np.hstack(added))

    def loose_among(self, sensors: tuple[int, ...]) -> FloatArray:
        """Return what ``among`` has beyond the system's covariance, shape (16 n, 16 n)."""
        keys = [key for sensor in sensors for key in keys_of(sensor)]
        root = self.loose[columns_at(self.columns, keys)]
        return np.asarray(root @ root.T)

    def of_system(self, sensors: tuple[int, ...]) -> FloatArray:
        """Return ``among`` as the system has it, shape (16 n, 16 n)."""
        return self.among(sensors) - self.loose_among(sensors)

    def after_step(self, rows: Rows) -> Rows:
        """Return rows with the residual after the step."""
        residual = rows.residual + rows.jacobian @ self.step[rows.columns]
        return replace(rows, residual=residual)

    def among(self, sensors: tuple[int, ...]) -> FloatArray:
        """Return the covariance of all parameters of some sensors, shape (16 n, 16 n)."""
        return self.covariance([key for sensor in sensors for key in keys_of(sensor)])

    def sigmas(self, sensor: int, along: FloatArray | None = None) -> float:
        """Return the length of a sensor's step in standard deviations.

        Parameters
        ----------
        sensor
            Index of the sensor.
        along
            Rows over its parameters that are looked at alone, shape (K, 16).
        """
        covariance = self.among((sensor,))
        step = self.step[columns_at(self.columns, keys_of(sensor))]
        if along is not None:
            covariance, step = along @ covariance @ along.T, along @ step
        sigma = np.sqrt(np.diag(covariance))
        lower = cholesky(covariance / np.outer(sigma, sigma), lower=True)
        step = step / sigma
        return float(np.sqrt(step @ cho_solve((lower, True), step)))

    def furthest(self, sensors: Sequence[int]) -> float:
        """Return the longest step of some sensors in standard deviations."""
        return max(self.sigmas(sensor) for sensor in sensors)

    def stepped(self, values: gtsam.Values, step: FloatArray | None = None) -> gtsam.Values:
        """Return the values after the step."""
        delta, step = gtsam.VectorValues(), self.step if step is None else step
        for key, at in self.columns.items():
            delta.insert(key, step[at])
        return values.retract(delta)

    def taken(self, sensor: int) -> float:
        """Return the degrees of freedom that a sensor's rows take beside its own sixteen.

        As many as there are weights that no prior and no other sensor determines, and less of its
        own where other sensors determine them.
        """
        return self._traces.get(sensor, 0.0) - SENSOR

    @cached_property
    def _traces(self) -> dict[int, float]:
        """Trace of ``J Sigma J^T`` over the rows of each sensor."""
        traces: dict[int, float] = {}
        for rows in self.rows:
            taken = blocks(submatrix(self.every, rows.columns), rows.jacobian, 1)
            traces[rows.sensor] = traces.get(rows.sensor, 0.0) + float(taken.sum())
        return traces


def joint_information(
    columns: Mapping[int, slice], rows: Sequence[Rows], weights: FloatArray, at: FloatArray
) -> JointInformation:
    """Solve a linear system.

    Parameters
    ----------
    columns
        Where each key's variables stand among all n; those of the K weights come first.
    rows
        White rows.
    weights, at
        Information of the weights' prior about zero, shape (K, K), and where they are, shape (K,).

    Raises
    ------
    CalibrationError
        The system is singular to rounding.
    """
    count, known = max(each.stop for each in columns.values()), len(weights)
    information, pull = np.zeros((count, count)), np.zeros(count)
    information[:known, :known] = weights
    pull[:known] = -weights @ at
    for each in rows:
        add_upper(information, each.columns, each.jacobian.T @ each.jacobian)
        pull[each.columns] -= each.jacobian.T @ each.residual
    # Jacobi's scaling: within a factor n of the best condition that any diagonal scaling gives
    # (van der Sluis 1969).
    scale = 1 / np.sqrt(np.diag(information))
    information *= scale
    information *= scale[:, None]
    try:  # of its upper triangle, which is the lower one of what is in LAPACK's order
        lower = cholesky(information.T, lower=True, overwrite_a=True, check_finite=False)
    except LinAlgError:
        lower = root_by_qr(rows, weights, scale)
    step = scale * cho_solve((lower, True), scale * pull, check_finite=False)
    every = inverse_of_factor(lower)
    every *= scale
    every *= scale[:, None]
    decrement = float(np.sqrt(max(pull @ step, 0.0)))
    return JointInformation(columns, rows, every, step, decrement, np.empty((count, 0)))


def root_by_qr(rows: Sequence[Rows], weights: FloatArray, scale: FloatArray) -> FloatArray:
    """Return the lower triangular root of the scaled information, (n, n), without squaring a row.

    Where something is known 1e8 times better than its neighbours a squared row has nothing left of
    these. It takes a hundred times as long as Cholesky; memory stays bounded.

    Raises
    ------
    CalibrationError
        The system is singular to rounding.
    """
    known, count = len(weights), len(scale)
    root = np.zeros((count, count))
    root[:known, :known] = cholesky(weights, lower=False) * scale[:known]
    waiting, height = [root], count
    for number, each in enumerate(rows, start=1):
        dense = np.zeros((len(each.residual), count))
        dense[:, each.columns] = each.jacobian * scale[each.columns]
        waiting.append(dense)
        height += len(dense)
        if height > 2 * count or number == len(rows):
            root = np.asarray(np.linalg.qr(np.concatenate(waiting), mode="r"))
            waiting, height = [root], count
    pivots = np.abs(np.diag(root))
    if not pivots.min() > ROUNDING * pivots.max():
        raise CalibrationError(
            "the covariances of sensors and map cannot be computed: what is known of poses, "
            "sensors and map is too many orders of magnitude apart"
        )
    return np.asfortranarray((root * np.sign(np.diag(root))[:, None]).T)


def slices_of(sizes: Mapping[int, int]) -> dict[int, slice]:
    """Return where each variable stands, one after the other, by their sizes."""
    ends = np.cumsum(list(sizes.values())).tolist()
    return {key: slice(end - sizes[key], end) for key, end in zip(sizes, ends, strict=True)}


def columns_at(columns: Mapping[int, slice], keys: Iterable[int]) -> IntArray:
    """Return where the variables of some keys stand, in their order."""
    at = [np.arange(columns[key].start, columns[key].stop) for key in keys]
    return np.concatenate([NO_READINGS, *at])


def rows_of_factors(
    linear: gtsam.GaussianFactorGraph, columns: Mapping[int, slice], owner: Mapping[int, int]
) -> list[Rows]:
    """Return the rows of linear factors; ``owner`` names the sensor of each sensor's keys."""
    found = []
    for index in range(linear.size()):
        jacobian, b = linear.at(index).jacobian()
        keys = list(linear.at(index).keys())
        owners = {owner[key] for key in keys if key in owner}
        sensor = owners.pop() if len(owners) == 1 else SHARED
        found.append(Rows(sensor, columns_at(columns, keys), jacobian, -b, NO_READINGS))
    return found

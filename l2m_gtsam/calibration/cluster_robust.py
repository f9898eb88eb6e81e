r"""Whether parts of a drive scatter about the whole as the covariance says, whatever the model.

At the optimum the score, the gradient of the cost by a sensor's parameters, is zero over all
readings, but not over a part of them. The scatter of the scores of disjoint parts gives the
variance of the estimate for errors of any size that are correlated within a part in any way: the
cluster-robust, or sandwich, covariance (Liang and Zeger, Biometrika 73, 1986)

.. math::
    P \Big(\sum_b g_b g_b^T\Big) P, \qquad g_b = J_b^T e_b

with the white Jacobian and residual of part b and the covariance P that the model states. The
residuals are those after the estimated errors of map and poses: what is shared counts once.

A fit makes its own residuals smaller. Under the model

.. math::
    \mathrm E\, g_b g_b^T = J_b^T (I - X_b \Sigma X_b^T) J_b

with the Jacobian X of all variables and their covariance :math:`\Sigma`. Compared with that the
scatter has no bias by few parts (Bell and McCaffrey, Survey Methodology 28, 2002), and its own
spread follows, so that chance is not taken for an excess.

An error that is the same in all parts, as a shift of the whole map, is not seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_gtsam.calibration.joint_information import HalfCovariance, Rows
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings
from l2m_gtsam.records.calibration import Unmodelled
from l2m_gtsam.solve.chi_square import quantile

HALVINGS = 4  # into sixteen parts; eight are pairs of them
FALSE_ALARMS = 0.002  # of calibrations whose errors are as modelled
BLOCKS = {"t": slice(0, 3), "C": slice(3, 12), "H": slice(12, 15), "offset": slice(15, 16)}
TESTS = 4 * len(BLOCKS)  # of a sensor: parts by time and by place, of two sizes


@dataclass(frozen=True)
class Scores:
    """Scores of one sensor's parameters over the parts of a drive.

    Attributes
    ----------
    found
        Shape (B, 16).
    expected
        Their covariances if all errors are as modelled, shape (B, 16, 16).
    """

    found: FloatArray
    expected: FloatArray

    def ratio(self, covariance: FloatArray, block: slice, false_alarms: float) -> float:
        """Return the variance found over that expected, one where chance explains the excess.

        Parameters
        ----------
        covariance
            P of the sensor's parameters, shape (16, 16).
        block
            The parameters whose variances are taken together, each in its own sigmas.
        false_alarms
            Probability of an excess that is none.
        """
        sigma = np.sqrt(np.diag(covariance)[block])
        correlation = covariance[block, block] / np.outer(sigma, sigma)
        lower = cholesky(correlation, lower=True)
        # White influence of a score on the block's estimates.
        influence = solve_triangular(lower, covariance[block] / sigma[:, None], lower=True)
        found = float(((self.found @ influence.T) ** 2).sum())
        parts = influence @ self.expected @ influence.T
        expected = float(np.trace(parts.sum(axis=0)))
        spread = float(2 * (parts * parts.transpose(0, 2, 1)).sum())  # variance of ``found``
        if not (expected > 0 and spread > 0):
            return 1.0
        freedom = 2 * expected**2 / spread  # Satterthwaite
        limit = float(quantile(1 - false_alarms, freedom)) / freedom
        ratio = found / expected
        return ratio if ratio > limit else 1.0


def unmodelled(
    readings: Readings, rows: Sequence[Rows], own: IntArray, covariance: HalfCovariance, tests: int
) -> Unmodelled:
    """Return how far variances of one sensor exceed those that the model explains.

    Parameters
    ----------
    readings
        All that took part.
    rows
        White rows of the sensor's readings at the optimum.
    own
        Where its sixteen parameters stand among all n variables, shape (16,).
    covariance
        Of all n variables.
    tests
        Number of sensors that are tested together.
    """
    used = np.unique(np.concatenate([each.readings for each in rows])) if rows else np.empty(0)
    if len(used) < 2**HALVINGS:
        return Unmodelled()
    P, alarms = covariance.among(own), FALSE_ALARMS / (TESTS * tests)
    labels = np.full(len(readings), -1)
    largest = dict.fromkeys(BLOCKS, 1.0)
    for axes in (readings.stamp_ns[used, None].astype(np.float64), readings.p_map_lidar[used]):
        labels[used] = halved(axes, HALVINGS)
        white = gathered(rows, labels, own, len(covariance))
        for merged in (white, white.paired()):
            scores = merged.scores(own, covariance)
            for name, block in BLOCKS.items():
                largest[name] = max(largest[name], scores.ratio(P, block, alarms))
    return Unmodelled(**largest)


def halved(points: FloatArray, times: int) -> IntArray:
    """Return the part of each point, shape (N,): all are halved along their longest axis, again.

    Parameters
    ----------
    points
        Shape (N, k).
    times
        How often; there are two to this power parts of one size, and ``part // 2`` are those of
        one halving less.
    """
    part = np.zeros(len(points), dtype=np.int64)
    for _ in range(times):
        later = np.zeros(len(points), dtype=np.bool_)
        for label in np.unique(part):
            rows = np.flatnonzero(part == label)
            axis = int(np.ptp(points[rows], axis=0).argmax())
            order = rows[np.argsort(points[rows, axis], kind="stable")]
            later[order[len(order) // 2 :]] = True
        part = 2 * part + later
    return part


@dataclass(frozen=True)
class Gathered:
    """Sums over the white rows of each part.

    Attributes
    ----------
    found
        ``J_b^T e_b``, shape (B, 16).
    crossed
        ``X_b^T J_b`` with all n variables, shape (B, n, 16).
    """

    found: FloatArray
    crossed: FloatArray

    def paired(self) -> "Gathered":
        """Return the same for parts twice as large."""
        return Gathered(self.found[::2] + self.found[1::2], self.crossed[::2] + self.crossed[1::2])

    def scores(self, own: IntArray, covariance: HalfCovariance) -> Scores:
        """Return scores, and what is expected of them."""
        expected = self.crossed[:, own].copy()
        for at, crossed in zip(expected, self.crossed, strict=True):
            # Of thousands of variables a part touches hundreds.
            touched = np.flatnonzero(crossed.any(axis=1))
            at -= covariance.across(touched, crossed[touched])
        return Scores(self.found, expected)


def gathered(rows: Sequence[Rows], labels: IntArray, own: IntArray, count: int) -> Gathered:
    """Return the sums of white rows by the labels of their readings.

    White rows of readings that were whitened together hold what each adds to those before it: they
    are independent, and go with their reading.

    Parameters
    ----------
    rows
        Of one sensor.
    labels
        Part of each reading of the view.
    own
        Where the sensor's parameters stand among all variables, shape (16,).
    count
        Number of all variables.
    """
    parts = 2**HALVINGS
    found, crossed = np.zeros((parts, SENSOR)), np.zeros((parts, count, SENSOR))
    for each in rows:
        order = np.argsort(each.columns)
        mine = order[np.searchsorted(each.columns, own, sorter=order)]
        J, label = each.jacobian[:, mine], np.repeat(labels[each.readings], 3)
        for part in np.unique(label):
            taken: BoolArray = label == part
            found[part] += J[taken].T @ each.residual[taken]
            crossed[part, each.columns] += each.jacobian[taken].T @ J[taken]
    return Gathered(found, crossed)

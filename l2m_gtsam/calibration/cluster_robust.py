r"""Whether parts of a drive scatter about the whole as the covariance says, whatever the model.

At the optimum the gradient of the cost is zero over all readings, but not over a part of them. What
each part pulls the estimate by is its score, and the scatter of the scores of disjoint parts gives
the variance of the estimate for errors of any size that are correlated within a part in any way:
the cluster-robust, or sandwich, covariance (Liang and Zeger, Biometrika 73, 1986)

.. math::
    \sum_b g_b g_b^T, \qquad g_b = Y_b^T e_b, \qquad Y_b = X_b \Sigma_{\cdot, own}

with the white Jacobian X by all variables, their covariance :math:`\Sigma` that the model states,
and the white residual e of part b. The residuals are those after the estimated errors of map and
poses: what is shared counts once.

A fit makes its own residuals smaller. Under the model

.. math::
    \mathrm E\, g_b g_b^T = Y_b^T (I - X_b \Sigma X_b^T) Y_b .

Compared with that the scatter has no bias by few parts (Bell and McCaffrey, Survey Methodology 28,
2002), and its own spread follows, so that chance is not taken for an excess. The covariance grows
by the ratio of both, but for what stated errors of the survey's sensors make of it: the map is made
of readings like the drive's, with errors that last like theirs; a stated error is what it is.

How well a ratio is known if errors are *not* as modelled is another matter: one cause may be behind
the scatter in all directions, and then B parts are B - 1 squares, whatever the number of directions
(Bester, Conley and Hansen, Journal of Econometrics 165, 2011). How many directions differ is seen
in the scores u_b themselves, white by the covariance, shape (B, n). For normal errors of rho
squares among parts and nu among directions

.. math::
    \frac{\mathrm{tr}\,(u^T u)^2}{(\mathrm{tr}\, u^T u)^2}
        \approx \frac1\rho + \frac1\nu + \frac1{\rho \nu}, \qquad \rho = B - 1

and the ratio is a mean of :math:`\rho \nu` squares. Errors of an estimate go the same few ways: a
squared distance in n dimensions, over n times the ratio, is about Fisher's with nu and
:math:`\rho \nu` degrees of freedom (Box, Annals of Mathematical Statistics 25, 1954).

An error that is the same in all parts, as a shift of the whole map, is not seen.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_gtsam.calibration.joint_information import Rows
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.records.error_budget import EXPLAINED, Unmodelled
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.linear_algebra import submatrix

HALVINGS = 4  # into sixteen parts; eight are pairs of them
FALSE_ALARMS = 0.002  # of calibrations whose errors are as modelled
BLOCKS = {"t": slice(0, 3), "C": slice(3, 12), "H": slice(12, 15), "offset": slice(15, 16)}
WHOLE = slice(0, 15)  # t, C and H together
TESTED = BLOCKS | {"whole": WHOLE}
NONE = np.empty(0, dtype=np.int64)
TINY = np.finfo(np.float64).tiny
TESTS = 4 * len(TESTED)  # of a sensor: parts by time and by place, of two sizes


@dataclass(frozen=True)
class Excess:
    """How far the scatter of a drive's parts exceeds the model's.

    Attributes
    ----------
    factors
        Variances found over those expected.
    whole
        The same of t, C and H together, in all directions alike.
    brought
        The covariance of (t, C row by row, H, time offset) by the model if the survey's sensors
        were exact, shape (16, 16).
    """

    factors: Unmodelled = EXPLAINED
    whole: float = 1.0
    brought: FloatArray = field(default_factory=lambda: np.zeros((SENSOR, SENSOR)))

    def widened(self, covariance: FloatArray) -> FloatArray:
        """Return a covariance of the model, (16, 16), with what the scatter adds to it.

        What is infinite, as not determined, stays so.
        """
        known = np.isfinite(np.diag(covariance))
        # What scatters in t, C and H together makes sums of them wrong that the model knows well.
        added = (self.whole - 1) * self.brought
        for name, block in BLOCKS.items():
            if (factor := getattr(self.factors, name)) <= self.whole:
                continue
            # All that hangs on the block grows with it, so that what is known of sums stays so:
            # the covariance ends between the model's and a multiple of that.
            across = self.brought[:, block]
            explained = across @ np.linalg.solve(self.brought[block, block], across.T)
            added += (factor - self.whole) * explained
        return np.asarray(covariance + np.where(np.outer(known, known), added, 0.0))


@dataclass(frozen=True)
class VarianceRatio:
    """A variance found over that expected.

    Attributes
    ----------
    value
        Their ratio.
    freedom
        How well it is known if errors are as modelled: it is a mean square of so many of them
        (Satterthwaite).
    parts
        How many squares the scatter has in each direction, B - 1.
    directions
        How many directions differ by the scatter itself, whatever the errors are.
    shown
        Which share of the variance by errors as modelled the scatter is expected to show.
    """

    value: float
    freedom: float
    parts: int
    directions: float
    shown: float

    def beyond_chance(self, false_alarms: float) -> float:
        """Return the ratio, one where chance explains the excess."""
        limit = float(quantile(1 - false_alarms, self.freedom)) / self.freedom
        return self.value if self.value > limit else 1.0


UNKNOWN = VarianceRatio(1.0, np.inf, 1, np.inf, 1.0)
Scatter = dict[str, VarianceRatio]  # of one division of a drive into parts, by what is tested


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

    def ratio(self, block: slice, white: FloatArray) -> VarianceRatio:
        """Return the variance found over that expected.

        Parameters
        ----------
        block
            The n parameters whose variances are taken together, each in its own sigmas.
        white
            From ``whitening_of`` their covariance, shape (n, n).
        """
        scores = self.found[:, block] @ white.T
        found = float((scores**2).sum())
        parts = white @ self.expected[:, block, block] @ white.T
        expected = float(np.trace(parts.sum(axis=0)))
        spread = float(2 * (parts * parts.transpose(0, 2, 1)).sum())  # variance of ``found``
        if not (expected > 0 and spread > 0):
            return UNKNOWN
        squares, freedom = len(scores) - 1, 2 * expected**2 / spread
        directions = min(directions_of(scores), freedom / squares)
        shown = expected / len(white)
        return VarianceRatio(found / expected, freedom, squares, directions, shown)


def whitening_of(covariance: FloatArray) -> FloatArray:
    """Return W with ``W P W^T = 1`` for a covariance P, (n, n), whatever its units are."""
    # Sums of squares in the metric of P: which axes a block is written in does not matter.
    sigma = np.sqrt(np.diag(covariance))
    lower = cholesky(covariance / np.outer(sigma, sigma), lower=True)
    return np.asarray(solve_triangular(lower, np.diag(1 / sigma), lower=True))


def directions_of(scores: FloatArray) -> float:
    """Return in how many of n directions white scores, (B, n), differ from part to part."""
    parts, together = len(scores) - 1, scores.T @ scores
    alike = float((together**2).sum() / max(np.trace(together) ** 2, TINY))
    differing = (1 + 1 / parts) / max(alike - 1 / parts, TINY)
    return float(np.clip(differing, 1, len(together)))


def scatters(
    readings: Readings, rows: Sequence[Rows], own: IntArray, covariance: FloatArray
) -> tuple[Scatter, ...]:
    """Return the scatter of parts by time and by place, of two sizes; none of few readings.

    Parameters
    ----------
    readings
        All that took part.
    rows
        White rows of the sensor's readings at the optimum.
    own
        Where its sixteen parameters stand among all n variables, shape (16,).
    covariance
        Of all n variables, shape (n, n).
    """
    parts, P, found = tuple(divisions(readings, rows)), submatrix(covariance, own), []
    if not parts:
        return ()
    white = {name: whitening_of(P[block, block]) for name, block in TESTED.items()}
    for labels in parts:
        sums = gathered(rows, labels, own, covariance)
        for merged in (sums, sums.paired()):
            scores = merged.scores(covariance)
            found.append({name: scores.ratio(at, white[name]) for name, at in TESTED.items()})
    return tuple(found)


def divisions(readings: Readings, rows: Sequence[Rows]) -> Iterator[IntArray]:
    """Return the part of each reading, shape (N,), by time and then by place; none of few readings.

    Parameters
    ----------
    readings
        All N that took part.
    rows
        Of those that are divided; the others are in no part, -1.
    """
    used = np.unique(np.concatenate([NONE, *(each.readings for each in rows)]))
    if len(used) < 2**HALVINGS:
        return
    for axes in (readings.stamp_ns[used, None].astype(np.float64), readings.p_map_lidar[used]):
        labels = np.full(len(readings), -1)
        labels[used] = halved(axes, HALVINGS)
        yield labels


def unmodelled(
    found: Sequence[Scatter],
    own: IntArray,
    covariance: FloatArray,
    tests: int,
    stated: IntArray = NONE,
) -> Excess:
    """Return how far variances of one sensor exceed those that the model explains.

    Parameters
    ----------
    found
        The scatter of parts of the drive.
    own
        Where its sixteen parameters stand among all n variables, shape (16,).
    covariance
        Of all n variables, shape (n, n).
    tests
        Number of sensors that are tested together.
    stated
        Where the errors of the survey's sensors stand, shape (s,).
    """
    if not found:
        return Excess()
    P, alarms = submatrix(covariance, own), FALSE_ALARMS / (TESTS * tests)
    largest = {name: max(each[name].beyond_chance(alarms) for each in found) for name in TESTED}
    whole = largest.pop("whole")
    factors = Unmodelled(**{name: max(whole, value) for name, value in largest.items()})
    across, theirs = covariance[np.ix_(own, stated)], submatrix(covariance, stated)
    return Excess(factors, whole, P - across @ np.linalg.solve(theirs, across.T))


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
        ``Y_b^T e_b``, shape (B, 16).
    brought
        ``Y_b^T Y_b``, shape (B, 16, 16).
    crossed
        ``X_b^T Y_b`` with all n variables, shape (B, n, 16).
    """

    found: FloatArray
    brought: FloatArray
    crossed: FloatArray

    def paired(self) -> "Gathered":
        """Return the same for parts twice as large."""
        sums = (each[::2] + each[1::2] for each in (self.found, self.brought, self.crossed))
        return Gathered(*sums)

    def scores(self, covariance: FloatArray) -> Scores:
        """Return scores of sixteen parameters among all variables, and what is expected of them."""
        expected = self.brought.copy()
        for at, crossed in zip(expected, self.crossed, strict=True):
            # Of thousands of variables a part touches hundreds.
            touched = np.flatnonzero(crossed.any(axis=1))
            among = submatrix(covariance, touched)
            at -= crossed[touched].T @ among @ crossed[touched]
        return Scores(self.found, expected)


def gathered(
    rows: Sequence[Rows], labels: IntArray, own: IntArray, covariance: FloatArray
) -> Gathered:
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
    covariance
        Of all n variables, shape (n, n).
    """
    parts, influence = 2**HALVINGS, covariance[:, own]
    found, brought = np.zeros((parts, SENSOR)), np.zeros((parts, SENSOR, SENSOR))
    crossed = np.zeros((parts, len(covariance), SENSOR))
    for each in rows:
        label = np.repeat(labels[each.readings], 3)
        order = np.argsort(label, kind="stable")
        J, e = each.jacobian[order], each.residual[order]
        Y, first = J @ influence[each.columns], np.searchsorted(label[order], np.arange(parts + 1))
        for part in np.flatnonzero(np.diff(first)):
            own_rows = slice(first[part], first[part + 1])
            y = Y[own_rows]
            found[part] += y.T @ e[own_rows]
            brought[part] += y.T @ y
            crossed[part, each.columns] += J[own_rows].T @ y
    return Gathered(found, brought, crossed)

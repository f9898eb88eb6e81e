r"""By how much the two halves of a drive differ in each sensor, from the graph of the whole.

If a sensor's t, C and H are :math:`\theta - d / 2` in the first half and :math:`\theta + d / 2` in
the second, white residuals are :math:`e + X x + Z d` with the Jacobian X by all variables and
:math:`Z = \pm J_\theta / 2`. At the optimum over x alone, with covariance :math:`\Sigma`,

.. math::
    d = -P Z^T e, \qquad P = \bigl(Z^T Z - Z^T X \Sigma X^T Z\bigr)^{-1}

so that both halves have one map, one set of priors and one set of processes, of the sizes that the
whole drive shows, and what these have in common is no difference. All sensors have a d at once:
what one of them does is not put down to the others.

Noise was estimated with d = 0: of a sensor that moved it holds the move. Covariances are therefore
those of the residuals that d leaves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from l2m_gtsam.calibration.joint_information import Rows
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, Readings
from l2m_gtsam.geometry import undetermined

JUDGED = 15  # t, C row by row, H: a clock is that of the whole drive
# Of the information that the readings had if all else were known: what has less is left open by a
# half. Rounding leaves 1e-12.
OPEN = 1e-9
TOUCHED = 1e-6  # share of a parameter in what is open


@dataclass(frozen=True)
class HalfDifference:
    """Second half less first of one sensor.

    Attributes
    ----------
    vector
        Of (t, C row by row, H) in m and uT, shape (15,).
    covariance
        Its covariance, shape (15, 15); variances of what a half leaves open are infinite.
    """

    vector: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class WhiteGroup:
    """White rows of some readings of a sensor, with what made them white.

    Attributes
    ----------
    rows
        At the optimum.
    whitening
        (n, 3, 3), or lower triangular (3 n, 3 n).
    """

    rows: Rows
    whitening: FloatArray

    def following(self, values: FloatArray, own: IntArray) -> FloatArray:
        """Return what parameters do that follow functions of the readings, shape (3 n, J k).

        Parameters
        ----------
        values
            J functions at the readings, shape (n, J).
        own
            Where k parameters stand among all variables, shape (k,).
        """
        order = np.argsort(self.rows.columns)
        at = order[np.searchsorted(self.rows.columns, own, sorter=order)]
        J, each = self.rows.jacobian[:, at], np.repeat(values, 3, axis=0)[:, :, None]
        if self.whitening.ndim == 3:
            return np.asarray((each * J[:, None]).reshape(len(J), -1))
        # A white row holds what its reading adds to those before it, of other values.
        raw = solve_triangular(self.whitening, J, lower=True)
        return np.asarray(self.whitening @ (each * raw[:, None]).reshape(len(J), -1))

    def split(self, sign: FloatArray, own: IntArray) -> FloatArray:
        """Return Z of this sensor, shape (3 n, 15), for the sign of each reading's half, (n,)."""
        return self.following(0.5 * sign[:, None], own)


def second_half(readings: Readings) -> BoolArray:
    """Return which readings are of the second half of a drive by the number of them, shape (N,)."""
    return np.asarray(readings.stamp_ns >= np.median(readings.stamp_ns))


@dataclass(frozen=True)
class HalvedSensor:
    """A sensor of the graph of the whole.

    Attributes
    ----------
    columns
        Where its t, C and H stand among all n variables, shape (15,).
    taken
        Degrees of freedom that the fit took of its readings.
    """

    columns: IntArray
    taken: float


def half_differences(
    groups: Sequence[WhiteGroup],
    later: BoolArray,
    halved: Mapping[int, HalvedSensor],
    every: FloatArray,
    loose: FloatArray,
) -> dict[int, HalfDifference]:
    """Return the differences of sensors.

    Parameters
    ----------
    groups
        All readings that count.
    later
        Which of the N readings of the view are of the second half, shape (N,).
    halved
        The sensors by their index.
    every
        Covariance of all n variables, shape (n, n).
    loose
        What it has beyond that of the system of which the rows are, a root, shape (n, l).
    """
    sign, count = np.where(later, 1.0, -1.0), JUDGED * len(halved)
    blocks = {s: slice(JUDGED * k, JUDGED * (k + 1)) for k, s in enumerate(halved)}
    alone, pull = np.zeros((count, count)), np.zeros(count)
    across, parts = np.zeros((len(every), count)), []
    for each in groups:
        at = blocks[each.rows.sensor]
        Z = each.split(sign[each.rows.readings], halved[each.rows.sensor].columns)
        parts.append(Z)
        alone[at, at] += Z.T @ Z
        pull[at] -= Z.T @ each.rows.residual
        across[each.rows.columns, at] += each.rows.jacobian.T @ Z
    by_loose = loose.T @ across
    followed = every @ across - loose @ by_loose  # all variables as d goes on
    information = alone - across.T @ followed
    found, covariance = solved(information, np.diag(alone), pull, by_loose)
    squares = dict.fromkeys(halved, 0.0)
    freedom = {s: -each.taken - JUDGED for s, each in halved.items()}
    for each, Z in zip(groups, parts, strict=True):
        moved = followed[each.rows.columns] @ found
        left = each.rows.residual + Z @ found[blocks[each.rows.sensor]] - each.rows.jacobian @ moved
        squares[each.rows.sensor] += float(left @ left)
        freedom[each.rows.sensor] += len(left)
    return {
        s: HalfDifference(found[at], covariance[at, at] * squares[s] / max(freedom[s], 1.0))
        for s, at in blocks.items()
    }


def solved(
    information: FloatArray, alone: FloatArray, pull: FloatArray, by_loose: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return an estimate with its covariance, infinite for what the information leaves open.

    Parameters
    ----------
    information
        Shape (k, k).
    alone
        Its diagonal if all else were known, shape (k,).
    pull
        Shape (k,).
    by_loose
        What errors add to the pull that the information does not count, shape (l, k).
    """
    scale = np.sqrt(np.where(alone > 0, alone, 1.0))
    values, axes = np.linalg.eigh(information / np.outer(scale, scale))
    sound = values > OPEN
    inverse = (axes[:, sound] / values[sound]) @ axes[:, sound].T / np.outer(scale, scale)
    root = inverse @ by_loose.T
    touched = np.square(axes[:, ~sound]).sum(axis=1) > TOUCHED
    covariance = undetermined(inverse + root @ root.T, touched)
    return np.where(touched, 0.0, inverse @ pull), covariance

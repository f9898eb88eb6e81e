r"""Whether parts of a survey saw one field, by what a map of all of them leaves of each.

In a square of the floor, the means of the residuals of K parts with n_k readings each differ by
chance alone if

.. math::
    \sum_k n_k |\bar e_k - \bar e|^2 / \sigma^2 \sim \chi^2_{3 (K - 1)}

A map follows whatever its readings have in common, so that of one field the sum over all squares is
rather smaller. Steel that came or went makes it several times as large, and so do poses and clocks
that are off: it tells that there is something to look for.
"""

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.solve.chi_square import quantile

CELL_M = 1.0
FEWEST = 4  # readings of a part in a square: whatever is wrong with one hardly moves their mean
SURE = 0.999


def is_kept_well(field_map: HarmonicMap) -> bool:
    """Return whether drives, each with what changed after it, differ by no more than chance."""
    learnt = field_map.learnt
    if learnt.history is None:
        return True
    return disagreement(field_map, learnt.readings, learnt.history.drive) < 1


def disagreement(field_map: HarmonicMap, readings: TrainingSet, part: IntArray) -> float:
    """Return by how much parts differ: 1 is what chance exceeds once in a thousand surveys.

    Parameters
    ----------
    field_map
        Made of all of them.
    readings
        N of them.
    part
        The number of the part of each, shape (N,).
    """
    known, noise = field_map.query(readings.points), field_map.learnt.hyperparameters.noise
    white = (readings.field - known.field) / noise
    at = np.flatnonzero(known.inside)
    squares, freedom = between_parts(readings[at], white[at], part[at])
    return squares / float(quantile(SURE, freedom)) if freedom else 0.0


def between_parts(readings: TrainingSet, white: FloatArray, part: IntArray) -> tuple[float, int]:
    """Return the sum of squares between the means of parts, and its degrees of freedom.

    Parameters
    ----------
    readings
        N of them.
    white
        What a map leaves of them, in sigmas of a reading of weight one, shape (N, 3).
    part
        To which each belongs, shape (N,).
    """
    weight, cells = readings.weight, np.floor(readings.points[:, :2] / CELL_M)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    group, of = np.unique(np.column_stack([cell, part]), axis=0, return_inverse=True)
    of = of.ravel()
    enough = np.bincount(of) >= FEWEST
    if not enough.any():
        return 0.0, 0
    n = np.bincount(of, weight)[enough]
    total = np.stack([np.bincount(of, weight * axis) for axis in white.T], axis=1)[enough]
    _, at, count = np.unique(group[enough, 0], return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(at, axis) for axis in total.T], axis=1)
    mean = sums / np.bincount(at, n)[:, None]
    apart = total / n[:, None] - mean[at]
    return float(np.sum(n[:, None] * apart**2)), 3 * int(np.sum(count - 1))

r"""The sums over a tile's readings, those of earlier drives as far as they still count.

Between two drives each weight of a tile may have moved by a random step, which leaves its prior as
it is:

.. math::
    w_{before} = \sqrt{1 - \rho^2} \, w_{after} + \rho \, \xi, \quad w_{after}, \xi \sim N(0, S)

With the step integrated out, sums over earlier readings become sums over the weights as they are
now: with ``rho = 0`` the same, with one nothing is left of them. How far the weights moved is what
makes the readings of both drives most likely together. A tile without new readings has no step:
nothing is forgotten by its age.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import (
    Normal,
    SharedNoise,
    evidence,
    marginalised,
    normal_of,
)
from l2m_gtsam.maps.harmonic.family import UniformField
from l2m_gtsam.maps.harmonic.history import STILL, TileStep
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.modes import Modes

# Shares that a field may have moved by, and depths of what moved: steps of two and more.
SHARES = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
DEPTHS = (0.0, 0.7, 2.0)  # metres
LEAST_GAIN = 2.0  # in nats, of a step over none: two more numbers have to be worth it
PAST = 3.0  # in nats, below the best: larger steps are not tried
INFORMATIVE = 0.3  # of a weight's information over that of its prior: others hardly matter


def tile_normal(
    learnt: Learnt,
    index: int,
    basis: Basis,
    rows: IntArray | None = None,
    gradient: FloatArray | None = None,
) -> Normal:
    """Return the sums over a tile's readings for its weights as they are now.

    Parameters
    ----------
    learnt, index
        The map and the tile.
    basis
        Of the tile, m weights.
    rows
        Of which readings; all of the tile's if absent.
    gradient
        Of the field at these in uT/m, shape (n, 3, 3), to count errors of their poses, if they have
        any; absent, poses count as exact.
    """
    rows = learnt.members[index] if rows is None else rows
    parts = by_drive(learnt, index, rows)
    normals = []
    for _, own in parts:
        slope = None if gradient is None else gradient[np.searchsorted(rows, own)]
        normals.append(normal_of(basis, learnt.readings[own], shared_noise(learnt, own, slope)))
    return carried_here(learnt, index, basis, [number for number, _ in parts], normals)


def tile_pull(
    learnt: Learnt, index: int, basis: Basis, columns: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Return ``F^T W`` times columns for a tile's readings, shape (n, 3, k), as far as they count.

    What readings share of the errors of their poses is taken out of ``W``, with the ``gradient`` of
    the field at them, shape (n, 3, 3).

    Returns
    -------
    FloatArray
        Shape (m, k).
    """
    rows = learnt.members[index]
    parts = by_drive(learnt, index, rows)
    if len(parts) < 2:
        return pull(basis, learnt, rows, columns, gradient)
    normals = []
    for _, own in parts:
        at = np.searchsorted(rows, own)
        pulled = pull(basis, learnt, own, columns[at], gradient[at])
        shared = shared_noise(learnt, own, gradient[at])
        normals.append(replace(normal_of(basis, learnt.readings[own], shared), Fy=pulled))
    return carried_here(learnt, index, basis, [number for number, _ in parts], normals).Fy


def pull(
    basis: Basis, learnt: Learnt, rows: IntArray, columns: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Return ``F^T W`` times columns of these readings, shape (n, 3, k): (m, k)."""
    readings = learnt.readings[rows]
    shared = shared_noise(learnt, rows, gradient)
    wrong = columns * readings.weight[:, None, None] if shared is None else shared.given(columns)
    pulled = np.zeros((len(basis), columns.shape[2]))
    for at in batches(len(rows)):
        F = basis.features(readings.points[at])
        pulled += F.reshape(-1, len(pulled)).T @ wrong[at].reshape(-1, wrong.shape[2])
    return pulled


def shared_noise(learnt: Learnt, rows: IntArray, gradient: FloatArray | None) -> SharedNoise | None:
    """Return what readings share of their noise, for the field's gradient there, (n, 3, 3)."""
    if learnt.poses is None or gradient is None:
        return None
    effects = learnt.poses.knots(rows, gradient)
    if not effects.white.shape[2]:  # the poses of these readings count as exact
        return None
    return SharedNoise(effects.white, learnt.readings.weight[rows], learnt.hyperparameters.noise)


def carried_here(
    learnt: Learnt, index: int, basis: Basis, numbers: Sequence[int], normals: Sequence[Normal]
) -> Normal:
    """Return sums over the readings of some drives for a tile's weights as they are now."""
    if len(normals) < 2:
        return normals[0]
    steps = learnt.past.steps_of(learnt.tiling.grid.cells[index])
    moved = []
    for first, last in pairwise(numbers):
        between = range(first + 1, last + 1)
        alike = [1 - moved_by(learnt, index, basis, k, steps[k]) ** 2 for k in between]
        moved.append(np.sqrt(1 - np.prod(alike, axis=0)))
    return carried(normals, moved, prior_sigma(learnt, basis), learnt.hyperparameters.noise)


def by_drive(learnt: Learnt, index: int, rows: IntArray) -> list[tuple[int, IntArray]]:
    """Return readings of a tile drive by drive, those between which it did not move together."""
    if not len(rows):
        return [(0, rows)]
    moved = learnt.moved_before(index)
    group = np.maximum.accumulate(np.where(moved, np.arange(len(moved)), 0))
    own = group[learnt.past.drive[rows]]
    return [(int(number), rows[own == number]) for number in np.unique(own)]


def moved_by(learnt: Learnt, index: int, basis: Basis, drive: int, step: TileStep) -> FloatArray:
    """Return how far each weight of a tile moved before a drive: rho, shape (m,)."""
    freed = learnt.past.freed_before(drive, learnt.structure_numbers(index))
    others, moved = iter(freed), np.zeros(len(basis))
    scale = learnt.hyperparameters.floor_scale
    for columns, family in zip(basis.columns, basis.families, strict=True):
        if isinstance(family, Modes):
            moved[columns] = step.share * np.exp(-np.abs(family.kz) * step.depth)
        elif isinstance(family, UniformField):  # moves as far as the longest waves do
            moved[columns] = step.share * min(1.0, scale / family.sigma)
        elif isinstance(family, Dipoles):
            moved[columns] = 1.0 if next(others) else step.share * (step.depth == 0)
    return moved


def likeliest_step(learnt: Learnt, index: int) -> TileStep:
    """Return how far a tile moved before the last drive, whose readings it has already."""
    history, rows = learnt.past, learnt.members[index]
    last = history.drives - 1
    new_rows = rows[history.drive[rows] == last]
    if not len(new_rows) or len(new_rows) == len(rows):
        return STILL
    basis = learnt.basis(index, rows)
    before = tile_normal(learnt, index, basis, np.setdiff1d(rows, new_rows))
    new = normal_of(basis, learnt.readings[new_rows])
    known = learnt.hyperparameters
    log_variance, noise = basis.prior(known).log_variance, known.noise
    # Weights that no reading tells anything of are none here: they are most of all.
    told = np.exp(log_variance) * np.diag((before + new).FF) / noise**2 > INFORMATIVE
    before, new, variance = among(before, told), among(new, told), log_variance[told]

    def value(step: TileStep) -> float:
        moved = moved_by(learnt, index, basis, last, step)[told]
        return likelihood(before, new, variance, noise, moved)

    best, found = value(STILL) + LEAST_GAIN, STILL
    for depth in DEPTHS:
        highest = -np.inf
        for share in SHARES:
            now = value(TileStep(share, depth))
            highest = max(highest, now)
            if now > best:
                best, found = now, TileStep(share, depth)
            if now < highest - PAST:
                break
    return found


def among(normal: Normal, kept: BoolArray) -> Normal:
    """Return the sums for some of m weights, (m,), alone."""
    at = np.flatnonzero(kept)
    return replace(normal, FF=normal.FF[np.ix_(at, at)], Fy=normal.Fy[at])


def kept_share(learnt: Learnt, index: int) -> float:
    """Return what is left of what readings before the last drive knew of a tile, 0 to 1."""
    history, rows = learnt.past, learnt.members[index]
    last = history.drives - 1
    basis = learnt.basis(index, rows)
    earlier = tile_normal(learnt, index, basis, rows[history.drive[rows] < last])
    step = history.steps_of(learnt.tiling.grid.cells[index])[last]
    moved, noise = moved_by(learnt, index, basis, last, step), learnt.hyperparameters.noise
    return share_left(earlier, prior_sigma(learnt, basis), noise, moved)


def prior_sigma(learnt: Learnt, basis: Basis) -> FloatArray:
    """Return the standard deviations of the weights' prior, that of the whole map, shape (m,)."""
    return np.asarray(np.exp(0.5 * basis.prior(learnt.hyperparameters).log_variance))


def faded(normal: Normal, prior_sigma: FloatArray, noise: float, moved: FloatArray) -> Normal:
    """Return the sums over readings after a step of the weights.

    Parameters
    ----------
    normal
        Sums for m weights as they were; ``Fy`` may have columns, shape (m,) or (m, k).
    prior_sigma
        Standard deviations of the weights' prior, shape (m,).
    noise
        Of a reading of weight one in uT.
    moved
        rho of each weight, 0 to 1, shape (m,).
    """
    free, m = np.flatnonzero(moved), len(moved)
    if not len(free):
        return normal
    # Beside the weights as they are now, xi of those that moved.
    at = np.append(np.arange(m), free)
    scale = np.append(np.sqrt(1 - moved**2), moved[free])
    FF, Fy = normal.FF[np.ix_(at, at)] * (scale[:, None] * scale), (normal.Fy[at].T * scale).T
    both = replace(normal, FF=FF, Fy=Fy)
    return marginalised(both, np.arange(m), 2 * np.log(prior_sigma[at]), noise)


def carried(
    normals: Sequence[Normal], moved: Sequence[FloatArray], prior_sigma: FloatArray, noise: float
) -> Normal:
    """Return the sums over the readings of all drives for the weights after the last one.

    Parameters
    ----------
    normals
        Of each drive, in order.
    moved
        Of each weight from each drive to the next, one fewer, shapes (m,).
    prior_sigma, noise
        As for ``faded``.
    """
    total = normals[0]
    for normal, each in zip(normals[1:], moved, strict=True):
        total = faded(total, prior_sigma, noise, each) + normal
    return total


def likelihood(
    before: Normal, new: Normal, log_variance: FloatArray, noise: float, moved: FloatArray
) -> float:
    """Return how likely readings before and after a step are, in nats.

    Parameters
    ----------
    before, new
        Sums over the readings before and after.
    log_variance
        Of the prior of the weights, shape (m,).
    noise
        In uT.
    moved
        rho of each weight, shape (m,).
    """
    old = faded(before, np.exp(0.5 * log_variance), noise, moved)
    return evidence(old + new, log_variance, noise).value


def share_left(normal: Normal, prior_sigma: FloatArray, noise: float, moved: FloatArray) -> float:
    """Return what is left of the information of readings after a step, 0 to 1.

    The mean over the weights that the readings know better than the prior.
    """
    gain = np.maximum(np.diag(normal.FF), 0.0) * (prior_sigma / noise) ** 2
    after = np.maximum(np.diag(faded(normal, prior_sigma, noise, moved).FF), 0.0)
    known = gain > 1
    left = after[known] * (prior_sigma[known] / noise) ** 2 / gain[known]
    return float(np.clip(np.mean(left), 0.0, 1.0)) if known.any() else 1.0

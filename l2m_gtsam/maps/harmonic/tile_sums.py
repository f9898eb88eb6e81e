"""The sums over a tile's readings, those of earlier drives as far as they still count."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import Normal, normal_of
from l2m_gtsam.maps.harmonic.fading import carried, likelihood, share_left
from l2m_gtsam.maps.harmonic.family import UniformField
from l2m_gtsam.maps.harmonic.history import STILL, TileStep
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.modes import Modes
from l2m_gtsam.maps.harmonic.shared_noise import SharedNoise

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
    return SharedNoise(effects.white, learnt.readings.weight[rows], learnt.hyperparameters.noise)


def carried_here(
    learnt: Learnt, index: int, basis: Basis, numbers: Sequence[int], normals: Sequence[Normal]
) -> Normal:
    """Return sums over the readings of some drives for a tile's weights as they are now."""
    history = learnt.history
    if history is None or len(normals) < 2:
        return normals[0]
    steps = history.steps_of(learnt.tiling.grid.cells[index])
    moved = []
    for first, last in pairwise(numbers):
        between = range(first + 1, last + 1)
        alike = [1 - moved_by(learnt, index, basis, k, steps[k]) ** 2 for k in between]
        moved.append(np.sqrt(1 - np.prod(alike, axis=0)))
    return carried(normals, moved, prior_sigma(learnt, basis), learnt.hyperparameters.noise)


def by_drive(learnt: Learnt, index: int, rows: IntArray) -> list[tuple[int, IntArray]]:
    """Return readings of a tile drive by drive, those between which it did not move together."""
    history = learnt.history
    if history is None or not len(rows):
        return [(0, rows)]
    steps = history.steps_of(learnt.tiling.grid.cells[index])
    near = learnt.structure_numbers(index)
    moved = [step.share > 0 or any(history.freed_before(k, near)) for k, step in enumerate(steps)]
    group = np.maximum.accumulate(np.where(moved, np.arange(len(steps)), 0))
    own = group[history.drive[rows]]
    return [(int(number), rows[own == number]) for number in np.unique(own)]


def moved_by(learnt: Learnt, index: int, basis: Basis, drive: int, step: TileStep) -> FloatArray:
    """Return how far each weight of a tile moved before a drive: rho, shape (m,)."""
    near, history = learnt.structure_numbers(index), learnt.history
    freed = [False] * len(near) if history is None else history.freed_before(drive, near)
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
    history, rows = learnt.history, learnt.members[index]
    if history is None:
        return STILL
    last = history.drives - 1
    new_rows = rows[history.drive[rows] == last]
    if not len(new_rows) or len(new_rows) == len(rows):
        return STILL
    basis = learnt.basis(index, rows)
    before = tile_normal(learnt, index, basis, np.setdiff1d(rows, new_rows))
    new = normal_of(basis, learnt.readings[new_rows])
    log_variance, noise = basis.prior(learnt.hyperparameters).log_variance, noise_of(learnt)
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
    history, rows = learnt.history, learnt.members[index]
    if history is None:
        return 1.0
    last = history.drives - 1
    basis = learnt.basis(index, rows)
    earlier = tile_normal(learnt, index, basis, rows[history.drive[rows] < last])
    step = history.steps_of(learnt.tiling.grid.cells[index])[last]
    moved = moved_by(learnt, index, basis, last, step)
    return share_left(earlier, prior_sigma(learnt, basis), noise_of(learnt), moved)


def prior_sigma(learnt: Learnt, basis: Basis) -> FloatArray:
    """Return the standard deviations of the weights' prior, that of the whole map, shape (m,)."""
    return np.asarray(np.exp(0.5 * basis.prior(learnt.hyperparameters).log_variance))


def noise_of(learnt: Learnt) -> float:
    """Return the standard deviation of a reading of weight one in uT."""
    return learnt.hyperparameters.noise

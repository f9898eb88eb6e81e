"""How errors of a map's tiles are correlated: by the survey's noise that they share.

Tiles share readings, and a pass that goes through several brings errors of its poses to all.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, tril

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.evidence import SharedNoise
from l2m_gtsam.maps.harmonic.learnt import Learnt
from l2m_gtsam.maps.harmonic.tiles import TileModes
from l2m_gtsam.maps.survey_poses import ErrorKnots, SurveyPoses
from l2m_gtsam.parallel.threads import in_threads

WHOLE = 1 - 1e-6  # of a variance: the survey's noise has no more of it
APART = 6.0  # in durations: errors of poses so far apart have 0.25 % in common


def joint_covariance(learnt: Learnt, tiles: dict[int, TileModes]) -> FloatArray:
    """Return the covariance of all beta: one in each tile, and what shared noise correlates."""
    indices = list(tiles)
    # What a step of the field lies between is left to each tile.
    present = [learnt.present(index) for index in indices]
    rows, pairs = shared_readings(present, len(learnt.readings))

    def seen(k: int) -> SeenNoise:
        return seen_noise(learnt, tiles[indices[k]], indices[k], rows[k])

    noises = in_threads(seen, range(len(indices)))
    starts = np.cumsum([0, *(len(modes) for modes in tiles.values())])
    covariance = np.eye(int(starts[-1]))
    if learnt.poses is not None:
        pairs = sorted({*pairs, *shared_poses(present, learnt.poses)})
    for i, j in pairs:
        shared = noises[i].together(noises[j])
        covariance[starts[i] : starts[i + 1], starts[j] : starts[j + 1]] = shared
        covariance[starts[j] : starts[j + 1], starts[i] : starts[i + 1]] = shared.T
    return covariance


@dataclass(frozen=True)
class SeenNoise:
    """What the survey's noise makes of r beta of a tile.

    Attributes
    ----------
    rows
        Readings that other tiles have, too, shape (n,).
    white
        Beta by a unit of the noise of each of them alone, shape (r, 3, n).
    poses
        What errors of the poses make of them; absent where poses are exact.
    """

    rows: IntArray
    white: FloatArray
    poses: "SeenPoses | None" = None

    def together(self, other: "SeenNoise") -> FloatArray:
        """Return the covariance with another tile's beta, shape (r, r')."""
        _, mine, theirs = np.intersect1d(
            self.rows, other.rows, assume_unique=True, return_indices=True
        )
        a, b = self.white[:, :, mine], other.white[:, :, theirs]
        shared = a.reshape(len(a), 3 * len(mine)) @ b.reshape(len(b), 3 * len(theirs)).T
        if self.poses is None or other.poses is None:
            return np.asarray(shared)
        return np.asarray(shared + self.poses.together(other.poses))


@dataclass(frozen=True)
class SeenPoses:
    """What errors of the survey's poses make of r beta of a tile.

    Attributes
    ----------
    knots
        Q times at which they are numbers of their own.
    beta
        By a unit of each of c errors there, shape (r, Q, c).
    """

    knots: ErrorKnots
    beta: FloatArray

    def together(self, other: "SeenPoses") -> FloatArray:
        """Return the covariance with another tile's beta, shape (r, r')."""
        correlation = self.knots.correlation(other.knots)
        return np.asarray(
            np.einsum("rqc,qp,spc->rs", self.beta, correlation, other.beta, optimize=True)
        )


def seen_noise(learnt: Learnt, modes: TileModes, index: int, shared: IntArray) -> SeenNoise:
    """Return what the survey's noise makes of a tile's beta; ``shared`` as ``SeenNoise.rows``."""
    readings, noise = learnt.readings, learnt.hyperparameters.noise
    if learnt.poses is None:
        scale = np.sqrt(readings.weight[shared]) / noise
        return SeenNoise(shared, modes.rows(readings.points[shared]) * scale)
    rows = learnt.present(index)
    points = readings.points[rows]
    _, gradient = modes.tile.field_and_gradient(points)
    effects = learnt.poses.knots(rows, gradient)
    weight = readings.weight[rows]
    pulled = SharedNoise(effects.white, weight, noise).given(modes.features(points)) / noise**2
    at = np.searchsorted(rows, shared)
    white = pulled[at].transpose(2, 1, 0) * (noise / np.sqrt(weight[at]))
    at_knots = np.einsum("nir,niqc->rqc", pulled, effects.effect, optimize=True)
    # The tile was solved with the gradient of exact poses: where the two differ, noise would make
    # more of beta than there is of it.
    alone = pulled.transpose(2, 1, 0) * (noise / np.sqrt(weight))
    poses = SeenPoses(effects.knots, at_knots)
    least = within_whole(SeenNoise(rows, alone, poses).together(SeenNoise(rows, alone, poses)))
    white = np.einsum("rs,sin->rin", least, white, optimize=True)
    return SeenNoise(shared, white, SeenPoses(effects.knots, np.tensordot(least, at_knots, 1)))


def within_whole(part: FloatArray) -> FloatArray:
    """Return what takes a part of unit variances, (r, r), to no more than the whole, (r, r)."""
    squares, axes = np.linalg.eigh(part)
    return np.asarray((axes / np.sqrt(np.maximum(squares / WHOLE, 1.0))) @ axes.T)


def shared_poses(members: list[IntArray], poses: SurveyPoses) -> list[tuple[int, int]]:
    """Return the pairs of tiles whose readings were taken while the same errors of poses lasted.

    Without them the covariance of all tiles, each next to the other on a pass, would be none.
    """
    cell = np.floor(poses.seconds / (APART * poses.lasting_s)).astype(np.int64)
    pair_tiles, pair_cells = [], []
    for tile, rows in enumerate(members):
        own = np.isin(poses.reading, rows)
        when = np.unique(np.stack([poses.drive[own], cell[own]], axis=1), axis=0)
        for later in (0, 1):
            pair_tiles.append(np.full(len(when), tile))
            pair_cells.append(when + np.array([0, later]))
    every, number = np.unique(np.concatenate(pair_cells), axis=0, return_inverse=True)
    tile_of = np.concatenate(pair_tiles)
    numbers: IntArray = np.asarray(number).ravel()
    return together(tile_of, numbers, (len(members), len(every)))


def together(tile: IntArray, number: IntArray, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the pairs of tiles that have a number in common, shapes (K,) both."""
    has = csr_array((np.ones(len(tile)), (tile, number)), shape=shape)
    pairs = tril(has @ has.T, -1)
    return list(zip(pairs.row.tolist(), pairs.col.tolist(), strict=True))


def shared_readings(
    members: list[IntArray], count: int
) -> tuple[list[IntArray], list[tuple[int, int]]]:
    """Return which readings of each tile another one has, too, and the pairs of such tiles.

    Parameters
    ----------
    members
        Rows of the readings of each tile, T arrays.
    count
        Number N of all readings.
    """
    tile = np.repeat(np.arange(len(members)), [len(rows) for rows in members])
    reading = np.concatenate([np.empty(0, dtype=np.int64), *members])
    often = np.bincount(reading, minlength=count) > 1
    pairs = together(tile, reading, (len(members), count))
    return [rows[often[rows]] for rows in members], pairs

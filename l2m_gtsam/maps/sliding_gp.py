"""Sliding Gaussian process regression: square blocks, each solved with the readings nearby.

The map of the paper (L2M-Calib, section "Prebuilt Multimodal Magnetic-LiDAR Map"): the area is
partitioned into blocks, and each is interpolated by a Gaussian process over the readings in it
and in a margin around it. All blocks share hyperparameters and prior mean, so that the map tends
to the dense process as the margin grows.

Posterior means are computed point by point (``posterior``, one length scale):

    mean_i     = sum_j k_j alpha_ji,    k_j = exp(-|x - y_j|^2 / 2)
    dmean_i/dx = -(1/l) sum_j (x - y_j) k_j alpha_ji

A solve asks for the same few hundred places again and again, a few of them in each block: for these
matrix products are too small. The loops are such that a compiler makes vector instructions of them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from typing import Any, Self

import numpy as np
from numba import njit
from pydantic import Field, model_validator

from l2m_gtsam.data import FieldAndGradient, FieldSample, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import masked
from l2m_gtsam.maps.grid import Grid, grid_over
from l2m_gtsam.maps.posterior import FAST, LEAST, Posterior, condition, exponentiate, scaled
from l2m_gtsam.maps.trained import GPMap, GPOptions, Trained
from l2m_gtsam.maps.training import checked_points
from l2m_gtsam.parallel.threads import in_threads

MOST_IN_BLOCK = 6000  # rows; the factor of such a block takes 290 MB
FACTOR_MEMORY = 1e9  # bytes of whiteners that are kept for variances
BATCH = 256  # points whose kernel rows are in memory, and about in cache, at once
PIECES = 8  # of a query, for threads: one for each visit of a block would cost more than it gains


class SlidingGPOptions(GPOptions):
    """Options of the sliding Gaussian process; lengths are in length scales."""

    block: float = Field(default=2.5, ge=0.5)
    """Edge of a block."""

    margin: float = Field(default=2.0, gt=0, le=10)
    """Readings this far around a block take part in it. At 2 the step from block to block is a
    tenth of the posterior's standard deviation."""

    @model_validator(mode="after")
    def _reach_within_margin(self) -> Self:
        if self.reach > self.margin:
            raise ValueError(f"reach {self.reach:g} must not exceed margin {self.margin:g}")
        return self


@dataclass(frozen=True)
class BlockQuery:
    """Points that one block answers for, as many as fit a batch.

    Attributes
    ----------
    block
        Index of the block in the grid, counted from 0.
    rows
        Indices of the points, shape (K,).
    """

    block: int
    rows: IntArray


@dataclass(frozen=True)
class SlidingGP(GPMap[SlidingGPOptions]):
    """A field map of Gaussian processes on square blocks.

    Attributes
    ----------
    grid
        Square blocks in x and y of the map frame, metres.
    blocks
        One posterior per block of the grid.
    """

    kind = "sliding_gp"
    model = SlidingGPOptions
    grid: Grid
    blocks: tuple[Posterior, ...]

    @classmethod
    def condition(cls, trained: Trained, options: SlidingGPOptions) -> "SlidingGP":
        """Return the map of readings whose hyperparameters are known.

        Raises
        ------
        MapError
            If a block holds too many readings or its covariance cannot be factorised.
        """
        unit, readings = trained.hyperparameters.length_scale, trained.readings
        grid = grid_over(readings.points, options.block * unit, options.reach * unit)
        members = grid.members(readings.points, options.margin * unit)
        check_sizes(members, grid.size)
        # One prior mean for all blocks: far from readings neighbours tend to the same field.
        blocks = tuple(posteriors(trained, members))
        return cls(trained, options, readings.mean, grid, blocks)

    def __reduce__(self) -> tuple[Any, ...]:
        # Factors of all blocks are hundreds of times as large as what they follow from.
        return _conditioned, (self.trained, self.options, self.frame)

    @cached_property
    def sums(self) -> "KernelSums":
        """The means of all blocks."""
        return KernelSums.of(self.blocks)

    @property
    def facts(self) -> dict[str, Any]:
        """Number and size of the blocks."""
        sizes = [len(block.y) for block in self.blocks]
        return {
            "blocks": len(sizes),
            "block (m)": self.grid.size,
            "readings in a block (median)": int(np.median(sizes)),
            "readings in a block (most)": max(sizes),
        }

    def query(self, points: FloatArray) -> FieldSample:
        """Return field, gradient and variance; see ``FieldMap``."""
        points = checked_points(points)
        field, gradient = self.field_and_gradient(points)
        variance, nearest = self._variance(points)
        return masked(FieldSample(field, gradient, variance, nearest <= self.options.reach**2))

    def field_and_gradient(self, points: FloatArray, /) -> FieldAndGradient:
        """Return field and gradient, also outside; see ``FieldMap``."""
        points = checked_points(points)
        field, gradient = self.sums.mean_and_gradient(points, self.grid.block_of(points))
        return field + self.mean, gradient

    def variance(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis, also outside; see ``FieldMap``."""
        return self._variance(checked_points(points))[0]

    def _variance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return variances (N, 3) and squares of distances to readings in length scales (N,)."""
        variance, nearest = np.empty(len(points)), np.empty(len(points))

        def ask(visits: Iterable[BlockQuery]) -> None:
            room = np.empty(BATCH * max(len(block.y) for block in self.blocks))
            for visit in visits:
                at = visit.rows
                variance[at], nearest[at] = self.blocks[visit.block].variance(points[at], room)

        visits = list(self._visits(points))
        kept = [self.blocks[visit.block].whitener is not None for visit in visits]
        quick = list(compress(visits, kept))
        in_threads(ask, (quick[piece::PIECES] for piece in range(PIECES)))
        ask(compress(visits, np.logical_not(kept)))  # one whitener at a time in memory
        return np.tile(variance[:, None], 3), nearest

    def _visits(self, points: FloatArray) -> Iterator[BlockQuery]:
        """Yield every point once, block by block and batch by batch."""
        owner = self.grid.block_of(points)
        # Sorted by block: each whitener is read, or computed again, for whole batches of points.
        order = np.argsort(owner, kind="stable")
        counts = np.bincount(owner)
        ends = np.cumsum(counts)
        for block in np.flatnonzero(counts):
            for start in range(ends[block] - counts[block], ends[block], BATCH):
                yield BlockQuery(int(block), order[start : min(start + BATCH, ends[block])])


def check_sizes(members: list[IntArray], block: float) -> None:
    """Refuse blocks whose factor would not fit in memory."""
    most = max(len(rows) for rows in members)
    if most > MOST_IN_BLOCK:
        raise MapError(
            f"a map block of {block:.3g} m holds {most} training readings with its margin, at "
            f"most {MOST_IN_BLOCK} are allowed; a larger spacing or a smaller block is needed"
        )


def posteriors(trained: Trained, members: list[IntArray]) -> Iterator[Posterior]:
    """Yield the posterior of each block, with its whitener as long as memory lasts."""
    mean, used = trained.readings.mean, 0
    for rows in members:
        posterior = condition(trained.readings[rows], mean, trained.hyperparameters)
        used += 8 * len(posterior.whitener.entries) if posterior.whitener else 0
        yield posterior if used <= FACTOR_MEMORY else posterior.without_whitener()


def _conditioned(trained: Trained, options: SlidingGPOptions, frame: str | None) -> SlidingGP:
    """Return a map that was taken apart to be sent."""
    return SlidingGP.condition(trained, options).in_frame(frame)


@dataclass(frozen=True)
class KernelSums:
    """The processes of all blocks.

    Attributes
    ----------
    length_scale
        Length scale of the kernel in metres.
    centres
        Origins of the blocks' scaled points in metres, shape (B, 3).
    first
        Where the training points of each block begin, and where the last end, shape (B + 1,).
    y
        Scaled training points of all blocks, shape (3, M).
    alpha
        Their weights in uT, shape (3, M).
    """

    length_scale: float
    centres: FloatArray
    first: IntArray
    y: FloatArray
    alpha: FloatArray

    @classmethod
    def of(cls, blocks: Sequence[Posterior]) -> "KernelSums":
        """Return the sums of these blocks, which share hyperparameters."""
        known = blocks[0].hyperparameters
        alpha = known.signal**2 * np.concatenate([block.alpha for block in blocks])
        return cls(
            length_scale=known.length_scale,
            centres=np.stack([block.centre for block in blocks]),
            first=np.cumsum([0, *(len(block.y) for block in blocks)]),
            y=np.ascontiguousarray(np.concatenate([block.y for block in blocks]).T),
            alpha=np.ascontiguousarray(alpha.T),
        )

    def mean_and_gradient(self, points: FloatArray, block: IntArray) -> FieldAndGradient:
        """Return the mean (N, 3) in uT without its constant and its gradient (N, 3, 3) in uT/m.

        Parameters
        ----------
        points
            Metres, shape (N, 3).
        block
            Which block answers for each, shape (N,).
        """
        x = scaled(points, self.centres[block], self.length_scale)
        mean, gradient = np.empty((len(x), 3)), np.empty((len(x), 3, 3))
        write_sums(x, block, self.first, self.y, self.alpha, mean, gradient)
        return mean, gradient / self.length_scale


@njit(cache=True, nogil=True)
def write_sums(
    x: FloatArray,
    block: IntArray,
    first: IntArray,
    y: FloatArray,
    alpha: FloatArray,
    mean: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the means (N, 3) and their gradients by scaled points (N, 3); see ``KernelSums``."""
    most = np.max(first[1:] - first[:-1])
    exponents, powers = np.empty(most), np.empty(most)
    for n in range(len(x)):
        start, end = first[block[n]], first[block[n] + 1]
        k, power = exponents[: end - start], powers[: end - start]
        # Row by row: of a piece of a matrix the compiler does not know that rows are contiguous.
        y0, y1, y2 = y[0, start:end], y[1, start:end], y[2, start:end]
        a0, a1, a2 = alpha[0, start:end], alpha[1, start:end], alpha[2, start:end]
        write_exponents(x[n], y0, y1, y2, k)
        exponentiate(k, power, power.view(np.int64))
        write_sum(x[n], y0, y1, y2, a0, a1, a2, k, mean[n], gradient[n])


@njit(cache=True, nogil=True, fastmath=FAST)
def write_exponents(
    x: FloatArray, y0: FloatArray, y1: FloatArray, y2: FloatArray, exponents: FloatArray
) -> None:
    """Write ``-|x - y|^2 / 2`` of one point and all training points, shape (M,)."""
    for j in range(len(exponents)):
        d0, d1, d2 = x[0] - y0[j], x[1] - y1[j], x[2] - y2[j]
        exponents[j] = max(-0.5 * (d0 * d0 + d1 * d1 + d2 * d2), LEAST)


@njit(cache=True, nogil=True, fastmath=FAST)
def write_sum(
    x: FloatArray,
    y0: FloatArray,
    y1: FloatArray,
    y2: FloatArray,
    a0: FloatArray,
    a1: FloatArray,
    a2: FloatArray,
    k: FloatArray,
    mean: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the mean (3,) at one point and its gradient (3, 3) by the scaled point."""
    b0 = b1 = b2 = 0.0
    g00 = g01 = g02 = g10 = g11 = g12 = g20 = g21 = g22 = 0.0
    for j in range(len(k)):
        d0, d1, d2 = y0[j] - x[0], y1[j] - x[1], y2[j] - x[2]
        w0, w1, w2 = k[j] * a0[j], k[j] * a1[j], k[j] * a2[j]
        b0 += w0
        b1 += w1
        b2 += w2
        g00 += w0 * d0
        g01 += w0 * d1
        g02 += w0 * d2
        g10 += w1 * d0
        g11 += w1 * d1
        g12 += w1 * d2
        g20 += w2 * d0
        g21 += w2 * d1
        g22 += w2 * d2
    mean[0], mean[1], mean[2] = b0, b1, b2
    gradient[0, 0], gradient[0, 1], gradient[0, 2] = g00, g01, g02
    gradient[1, 0], gradient[1, 1], gradient[1, 2] = g10, g11, g12
    gradient[2, 0], gradient[2, 1], gradient[2, 2] = g20, g21, g22

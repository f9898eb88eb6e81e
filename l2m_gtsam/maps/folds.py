"""Readings dealt out to folds by patches of the floor: what builds a map, and what judges it."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.options import Options

LARGEST_FOLD, LEAST_FOLD, SMALLER = 1.5, 0.1, 0.8  # metres, and the step between
PATCHES_IN_FOLD = 4  # fewer, and the luck of the deal decides
ASIDE = 0.1  # of the training readings, which determine the noise


class FoldOptions(Options):
    """How readings are held out."""

    fold: float | None = Field(default=None, ge=LEAST_FOLD)
    """Edge of a patch in metres: the size of the gaps that the maps have to bridge. If not given,
    1.5, made smaller by fifths until the readings fill four patches per fold, not below 0.1."""

    folds: int = Field(default=4, ge=2, le=20)
    """Groups that the patches are dealt out to; as many maps of each kind are built."""

    seed: int = Field(default=0, ge=0)
    """Seed of the dealing."""


@dataclass(frozen=True)
class Fold:
    """Rows of the readings that build a map, that determine the noise, and that judge it."""

    training: IntArray
    aside: IntArray
    held_out: IntArray


def fitting_fold(points: FloatArray, options: FoldOptions) -> float:
    """Return the edge of a patch in metres that is given, or that suits the points, (N, 3)."""
    if options.fold is not None:
        return options.fold
    edges = [LARGEST_FOLD]
    while edges[-1] > LEAST_FOLD / SMALLER:
        edges.append(SMALLER * edges[-1])
    wanted = PATCHES_IN_FOLD * options.folds
    fills = (edge for edge in edges if int(patches_of(points, edge).max()) + 1 >= wanted)
    return next(fills, edges[-1])


def patches_of(points: FloatArray, edge: float) -> IntArray:
    """Return the square patch of an edge in metres that each point lies in, shape (N,)."""
    squares = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / edge)
    _, patch = np.unique(squares, axis=0, return_inverse=True)
    return np.asarray(patch, dtype=np.int64)


def folds_of(patch: IntArray, options: FoldOptions) -> tuple[Fold, ...]:
    """Return the folds that the patches are dealt out to; each holds about as many patches.

    Raises
    ------
    MapError
        If there are fewer patches than folds.
    """
    patches = int(patch.max()) + 1
    if patches < options.folds:
        raise MapError(
            f"the readings fill {patches} patches, too few to compare maps in {options.folds} "
            "folds; a longer drive or a smaller fold is needed"
        )
    rng = np.random.default_rng(options.seed)
    group = (rng.permutation(patches) % options.folds)[patch]
    return tuple(fold_without(group == index, rng) for index in range(options.folds))


def fold_without(held_out: BoolArray, rng: np.random.Generator) -> Fold:
    """Return the fold that holds out where the mask, shape (N,), is true."""
    others = rng.permutation(np.flatnonzero(~held_out))
    aside = int(np.ceil(ASIDE * len(others)))
    # In their old order, for maps may depend on it to rounding.
    return Fold(np.sort(others[aside:]), np.sort(others[:aside]), np.flatnonzero(held_out))

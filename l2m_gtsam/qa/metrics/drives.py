"""Calibrations of one sensor on several drives, each by itself, beside each other."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.metrics.halves import Part, compare_halves, no_halves
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.metrics import DriveRepeat, Repeatability
from l2m_gtsam.solve.chi_square import quantile

TINY = 1e-12  # relative to the largest, of variances in units of useful sigmas
BAND = 0.95
GROUPS = (slice(0, 3), slice(3, 12), slice(12, 15))  # t, C, H
OPEN = "this drive and the others determine nothing of it that both do"


@dataclass(frozen=True)
class Common:
    """What several parts say together.

    Attributes
    ----------
    part
        Their common value: the best linear unbiased one.
    squared
        Squared distance of all parts from it in sigmas.
    freedom
        Number of values that it was averaged from, less those of itself.
    """

    part: Part
    squared: float
    freedom: int


def compare_drives(drives: Sequence[tuple[str, Part | str]]) -> Repeatability:
    """Return how calibrations on several drives differ.

    Parameters
    ----------
    drives
        Path of each drive with what it says of the sensor, or why it says nothing.
    """
    parts = [part for _, part in drives if isinstance(part, Part) and part.known.any()]
    repeats = tuple(_repeat(bag, part, parts) for bag, part in drives)
    if len(parts) < 2:
        return Repeatability(0.0, 0, 0.0, 0.0, repeats)
    whole = common(parts)
    low, high = (
        float(quantile(share, max(whole.freedom, 1))) for share in ((1 - BAND) / 2, (1 + BAND) / 2)
    )
    return Repeatability(whole.squared, whole.freedom, low, high, repeats)


def common(parts: Sequence[Part]) -> Common:
    """Return what parts say together, by generalised least squares.

    What a part leaves open takes no part; what all leave open stays open.
    """
    kept = [np.flatnonzero(part.known) for part in parts]
    y = np.concatenate([part.vector[at] for part, at in zip(parts, kept, strict=True)])
    S = _covariance(parts, kept)
    scale = np.sqrt(np.diag(S))
    values, axes = np.linalg.eigh(S / np.outer(scale, scale))
    sound = values > TINY * values[-1]
    W = (axes[:, sound] / np.sqrt(values[sound])).T / scale
    found = np.unique(np.concatenate(kept))
    A = np.concatenate([np.eye(15)[at] for at in kept])[:, found]
    size = np.array([min(_sigma(p, k) for p in parts if p.known[k]) for k in found])
    by_y = size[:, None] * np.linalg.pinv(W @ A * size) @ W
    left = W @ (y - A @ (by_y @ y))
    vector, covariance = np.full(15, np.nan), np.diag(np.full(15, np.inf))
    vector[found] = by_y @ y
    covariance[np.ix_(found, found)] = by_y @ S @ by_y.T
    root = None
    if all(part.shared_root is not None for part in parts):
        # all have one here, which the type does not know
        rows = [part.shared_root[at] for part, at in zip(parts, kept, strict=True)]  # type: ignore[index]
        root = np.zeros((15, rows[0].shape[1]))
        root[found] = by_y @ np.concatenate(rows)
    freedom = max(int(sound.sum()) - len(found), 0)
    return Common(Part(vector, covariance, root), float(left @ left), freedom)


def _covariance(parts: Sequence[Part], kept: Sequence[IntArray]) -> FloatArray:
    """Return the covariance of what parts know, side by side."""
    blocks = [
        [
            (one.covariance if one is other else one.shared(other))[np.ix_(mine, theirs)]
            for other, theirs in zip(parts, kept, strict=True)
        ]
        for one, mine in zip(parts, kept, strict=True)
    ]
    return np.block(blocks)


def _sigma(part: Part, parameter: int) -> float:
    return float(np.sqrt(part.covariance[parameter, parameter]))


def _repeat(bag: str, part: Part | str, parts: Sequence[Part]) -> DriveRepeat:
    """Return one drive beside the others."""
    nothing = float("nan")
    if isinstance(part, str):
        none = (nothing,) * 15
        return DriveRepeat(bag, none, (float("inf"),) * 15, no_halves(part), (nothing,) * 3)
    sigma = np.sqrt(np.diag(part.covariance))
    vector = np.where(part.known, part.vector, nothing)
    others = [each for each in parts if each is not part]
    if not part.known.any():
        against = no_halves("this drive determines nothing of it by itself")
    elif not others:
        against = no_halves("there is no other drive to compare with")
    else:
        against = compare_halves(common(others).part, part)
        if against.reason:
            against = no_halves(OPEN)
    largest = _largest(against.difference, against.sigma)
    return DriveRepeat(bag, row(vector), row(sigma), against, largest)


def _largest(difference: Sequence[float], sigma: Sequence[float]) -> tuple[float, ...]:
    """Return the largest difference in sigmas of t, C and H; NaN where nothing is known."""
    d, s = np.abs(np.array(difference)), np.array(sigma)
    known = np.isfinite(s) & (s > 0) & np.isfinite(d)
    ratio = np.where(known, d / np.where(known, s, 1.0), np.nan)
    return row([np.nanmax(ratio[at]) if known[at].any() else np.nan for at in GROUPS], 2)

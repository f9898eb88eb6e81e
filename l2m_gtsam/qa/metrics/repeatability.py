"""Calibrations of one sensor on different readings: halves of a drive, or several drives."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.half_difference import HalfDifference
from l2m_gtsam.data import BoolArray, Distortion, FloatArray, IntArray
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.repeatability import DriveRepeat, GroupDistance, Halves, Repeatability
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.linear_algebra import sound_information_root

BAND = 0.95
GROUPS = {"t": slice(0, 3), "C": slice(3, 12), "H": slice(12, 15)}
SEVERAL = "several drives are compared with each other instead of halves of one"
NOT_DONE = "halves of the drive were not calibrated by themselves (`qa.halves`)"
OPEN = "this drive and the others determine nothing of it that both do"


@dataclass(frozen=True)
class PartialEstimate:
    """What a part of the readings determines of a sensor.

    Attributes
    ----------
    vector
        (t, C row by row, H) in m and uT, shape (15,).
    covariance
        Its covariance, shape (15, 15); variances of what it leaves open are infinite.
    shared_root
        Two parts have ``root_a @ root_b.T`` of their covariances in common, shape (15, K); absent
        where that is not known.
    """

    vector: FloatArray
    covariance: FloatArray
    shared_root: FloatArray | None = None

    @property
    def known(self) -> BoolArray:
        """What it determines, shape (15,)."""
        return np.isfinite(np.diag(self.covariance))

    def shared(self, other: "PartialEstimate") -> FloatArray:
        """Return the covariance with another part, shape (15, 15); zero where it is not known."""
        if self.shared_root is None or other.shared_root is None:
            return np.zeros_like(self.covariance)
        return np.asarray(self.shared_root @ other.shared_root.T)


def no_halves(reason: str) -> Halves:
    """Return that there is no comparison, and why."""
    nothing = float("nan")
    return Halves((nothing,) * 15, (nothing,) * 15, nothing, 0, nothing, reason)


def compare_halves(first: PartialEstimate, second: PartialEstimate) -> Halves:
    """Return by how much two calibrations differ, in units and in sigmas.

    Errors that both share, of the same places of the map, drop out as far as they are known to be
    shared. Else they count as if each had its own: the distance is then too small rather than too
    large.
    """
    covariance = first.covariance + second.covariance
    # Cov(b - a) = Cov(a) + Cov(b) - Cov(a, b) - Cov(b, a).
    if first.shared_root is not None and second.shared_root is not None:
        covariance -= first.shared(second) + second.shared(first)
    a, b = (np.where(part.known, part.vector, np.nan) for part in (first, second))
    return _judged(b - a, covariance, _turned(a, b))


def halves_of(middle: FloatArray, found: HalfDifference) -> Halves:
    """Return by how much the halves of a drive differ, by the solve of the whole.

    Parameters
    ----------
    middle
        (t, C row by row, H) of the whole drive, shape (15,).
    found
        What the halves differ by.
    """
    first, second = middle - found.vector / 2, middle + found.vector / 2
    return _judged(found.vector, found.covariance, _turned(first, second))


def _judged(difference: FloatArray, covariance: FloatArray, turned_deg: float) -> Halves:
    """Return a difference in its covariance, (15,) and (15, 15), infinite where it is open."""
    known = np.isfinite(np.diag(covariance))
    if not known.any():
        return no_halves("the halves of the drive determine nothing of it by themselves")
    squared, determined = _squared(difference, covariance, known)
    groups = []
    for name, at in GROUPS.items():
        own = known & np.isin(np.arange(len(known)), np.arange(15)[at])
        if own.any():
            groups.append(GroupDistance(name, *_squared(difference, covariance, own)))
    return Halves(
        difference=row(difference),
        sigma=row(np.sqrt(np.diag(covariance))),
        distance=float(np.sqrt(squared / determined)),
        determined=determined,
        turned_deg=turned_deg,
        groups=tuple(groups),
    )


def _squared(difference: FloatArray, covariance: FloatArray, taken: BoolArray) -> tuple[float, int]:
    """Return the squared distance of some parameters in sigmas, and of how many directions."""
    along = sound_information_root(covariance[np.ix_(taken, taken)]) @ difference[taken]
    return float(along @ along), len(along)


def _turned(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between the rotations in two calibrations in degrees.

    NaN where one leaves C open, or a part of it.
    """
    if not np.isfinite([first[3:12], second[3:12]]).all():
        return float("nan")
    polar = []
    for vector in (first, second):
        U, _, Vt = np.linalg.svd(Distortion.from_vector(vector[3:]).C)
        polar.append(U @ Vt)
    turn = polar[0].T @ polar[1]
    # One mirrored and one not: no rotation leads from one to the other.
    if np.linalg.det(turn) < 0:
        return float("nan")
    return float(np.rad2deg(Rotation.from_matrix(turn).magnitude()))


@dataclass(frozen=True)
class CommonEstimate:
    """What several parts determine together.

    Attributes
    ----------
    part
        Their common value: the best linear unbiased one.
    squared
        Squared distance of all parts from it in sigmas.
    freedom
        Number of values that it was averaged from, less those of itself.
    """

    part: PartialEstimate
    squared: float
    freedom: int


def compare_drives(drives: Sequence[tuple[str, PartialEstimate | str]]) -> Repeatability:
    """Return how calibrations on several drives differ.

    Parameters
    ----------
    drives
        Path of each drive with its estimate of the sensor, or why there is none.
    """
    parts = [part for _, part in drives if isinstance(part, PartialEstimate) and part.known.any()]
    repeats = tuple(_repeat(bag, part, parts) for bag, part in drives)
    if len(parts) < 2:
        return Repeatability(0.0, 0, 0.0, 0.0, repeats)
    whole = common(parts)
    low, high = (
        float(quantile(share, max(whole.freedom, 1))) for share in ((1 - BAND) / 2, (1 + BAND) / 2)
    )
    return Repeatability(whole.squared, whole.freedom, low, high, repeats)


def common(parts: Sequence[PartialEstimate]) -> CommonEstimate:
    """Return what parts determine together, by generalised least squares.

    What a part leaves open takes no part; what all leave open stays open.
    """
    kept = [np.flatnonzero(part.known) for part in parts]
    y = np.concatenate([part.vector[at] for part, at in zip(parts, kept, strict=True)])
    S = _covariance(parts, kept)
    # Parts that share all errors of a direction count once (Aitken's estimator).
    W = sound_information_root(S)
    found = np.unique(np.concatenate(kept))
    A = np.concatenate([np.eye(15)[at] for at in kept])[:, found]
    # Columns in units of sigmas, so that the pseudo-inverse cuts metres and microtesla alike.
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
    freedom = max(len(W) - len(found), 0)
    return CommonEstimate(PartialEstimate(vector, covariance, root), float(left @ left), freedom)


def _covariance(parts: Sequence[PartialEstimate], kept: Sequence[IntArray]) -> FloatArray:
    """Return the covariance of what parts know, side by side."""
    blocks = [
        [
            (one.covariance if one is other else one.shared(other))[np.ix_(mine, theirs)]
            for other, theirs in zip(parts, kept, strict=True)
        ]
        for one, mine in zip(parts, kept, strict=True)
    ]
    return np.block(blocks)


def _sigma(part: PartialEstimate, parameter: int) -> float:
    return float(np.sqrt(part.covariance[parameter, parameter]))


def _repeat(bag: str, part: PartialEstimate | str, parts: Sequence[PartialEstimate]) -> DriveRepeat:
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
    return row([np.nanmax(ratio[at]) if known[at].any() else np.nan for at in GROUPS.values()], 2)

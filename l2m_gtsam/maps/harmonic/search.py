"""Sources where nobody looked: a greedy search of the space that the survey never visited."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.dipoles import moment_features
from l2m_gtsam.maps.harmonic.evidence import condition, normal_of
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.options import Options

# Standard deviations of a source's moment that are tried, over the one its readings suggest.
STRENGTHS = (0.3, 1.0, 3.0)
REFINEMENTS = 2  # each halves the lattice around a source that was found
MOST_READINGS = 1000  # of one tile


class SearchOptions(Options):
    """The search for sources without a point cloud; lengths in metres."""

    rounds: int = Field(default=12, ge=0)
    """The most rounds; 0 searches nothing. A round takes the best sources that
    lie far enough apart."""
    pitch: float = Field(default=0.4, gt=0.05)
    """Edge of the lattice of places that are tried."""
    clearance: float = Field(default=0.2, gt=0)
    """Space this near to a reading was visited: no source is there."""
    reach: float = Field(default=1.2, gt=0)
    """Sources further from every reading are left to floor and ceiling modes."""
    gain: float = Field(default=15.0, gt=0)
    """A source is taken if it makes the readings more likely by a factor of e to this power."""
    apart: float = Field(default=1.0, gt=0)
    """Sources of one round keep this distance: what one explains the other must not."""


@dataclass(frozen=True)
class Found:
    """A source that the residuals ask for: where, and how much it gains in nats."""

    position: FloatArray
    gain: float


@dataclass(frozen=True)
class Search:
    """Scores of candidate places against what m weights of a tile leave of its N readings.

    Attributes
    ----------
    points
        Of the readings, map frame, metres, shape (N, 3).
    scale
        What makes their noise white, in 1/uT, shape (N,).
    left
        What is left of them, white, shape (3 N,).
    half
        Root of the covariance of their prediction, white, shape (3 N, m).
    """

    points: FloatArray
    scale: FloatArray
    left: FloatArray
    half: FloatArray

    @classmethod
    def of(cls, basis: Basis, readings: TrainingSet, hyperparameters: Hyperparameters) -> "Search":
        """Return the scores beside what a basis explains."""
        log_variance, noise = basis.prior(hyperparameters).log_variance, hyperparameters.noise
        weights = condition(normal_of(basis, readings), log_variance, noise)
        scale = np.sqrt(readings.weight) / noise
        F = basis.features(readings.points).reshape(-1, len(basis))
        F *= np.repeat(scale, 3)[:, None]
        left = (readings.field * scale[:, None]).ravel() - F @ weights.mean
        return cls(readings.points, scale, left, weights.root(F))

    def gains(self, places: FloatArray) -> FloatArray:
        """Return how many nats a source at each place (K, 3) gains at its best strength, (K,)."""
        K = len(places)
        gains = np.empty(K)
        for start in range(0, K, 64):
            gains[start : start + 64] = self._gains(places[start : start + 64])
        return gains

    def _gains(self, places: FloatArray) -> FloatArray:
        K, m = len(places), self.half.shape[1]
        moments = moment_features(self.points, places) * self.scale[:, None, None]
        # Axis by axis: sums over rows then run along the places.
        Phi = np.ascontiguousarray(moments.reshape(-1, K, 3).transpose(0, 2, 1))
        rows = Phi.reshape(-1, 3 * K)
        seen = (self.half.T @ rows).reshape(m, 3, K)
        q = (self.left @ rows).reshape(3, K)
        s = np.empty((K, 3, 3))
        for i in range(3):
            for j in range(i + 1):
                known = np.einsum("nk,nk->k", Phi[:, i], Phi[:, j])
                s[:, i, j] = known - np.einsum("mk,mk->k", seen[:, i], seen[:, j])
                s[:, j, i] = s[:, i, j]
        return best_gain(s, np.ascontiguousarray(q.T))


def best_gain(s: FloatArray, q: FloatArray) -> FloatArray:
    """Return the gain in evidence of adding three weights, at the best of a few prior scales.

    After M. Tipping and A. Faul, "Fast marginal likelihood maximisation for sparse Bayesian
    models" (2003), for a block of three weights of one variance.

    Parameters
    ----------
    s
        What the readings know of the weights beside what is in the model, shape (K, 3, 3).
    q
        Their pull on the weights, shape (K, 3).
    """
    # In the axes of the information the three components of a moment are independent.
    values, vectors = np.linalg.eigh(s)
    values = np.maximum(values, 1e-12)
    pull = np.einsum("kij,ki->kj", vectors, q) ** 2
    # The scale that explains the pull if all three components are known alike.
    suggested = np.maximum(np.mean(pull / values**2 - 1 / values, axis=1), 0.0)
    gains = []
    for factor in STRENGTHS:
        variance = (factor**2 * suggested)[:, None]
        shrunk = variance / (1 + variance * values)
        gains.append(0.5 * np.sum(pull * shrunk - np.log1p(variance * values), axis=1))
    return np.asarray(np.max(gains, axis=0))


def unvisited(points: FloatArray, options: SearchOptions) -> FloatArray:
    """Return lattice places within reach of the readings, but not where the sensor was, (K, 3)."""
    lower = np.floor((points.min(axis=0) - options.reach) / options.pitch)
    upper = np.ceil((points.max(axis=0) + options.reach) / options.pitch)
    axes = [np.arange(a, b + 1) * options.pitch for a, b in zip(lower, upper, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    away, _ = cKDTree(points).query(lattice, distance_upper_bound=options.reach)
    return np.asarray(lattice[np.isfinite(away) & (away >= options.clearance)])


def look_for_sources(search: Search, places: FloatArray, options: SearchOptions) -> list[Found]:
    """Return the sources of one round: the best of some places (K, 3), apart from each other."""
    visited = cKDTree(search.points)
    gains = search.gains(places)
    good = np.flatnonzero(gains >= options.gain)
    wanted = apart([Found(places[k], float(gains[k])) for k in good], options.apart)
    return [refined(search, visited, start, options) for start in wanted]


def apart(found: list[Found], distance: float) -> list[Found]:
    """Return the best sources that keep a distance from each other, best first."""
    kept: list[Found] = []
    for each in sorted(found, key=lambda one: -one.gain):
        away = [np.linalg.norm(each.position - other.position) for other in kept]
        if min(away, default=np.inf) >= distance:
            kept.append(each)
    return kept


def refined(search: Search, visited: cKDTree, start: Found, options: SearchOptions) -> Found:
    """Return a source moved to the best place around it, on ever finer lattices."""
    best, step = start, options.pitch
    ring = np.stack(np.meshgrid(*([-1, 0, 1],) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(REFINEMENTS):
        step *= 0.5
        places = best.position + step * ring
        away, _ = visited.query(places)
        places = places[np.asarray(away) >= options.clearance]
        gains = search.gains(places)
        if len(gains) and gains.max() > best.gain:
            best = Found(places[int(gains.argmax())], float(gains.max()))
    return best

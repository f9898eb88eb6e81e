"""Sources where nobody looked: a greedy search of the space that the survey never visited."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis, batches
from l2m_gtsam.maps.harmonic.dipoles import moment_features
from l2m_gtsam.maps.harmonic.evidence import Weights, condition, normal_of
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
class Residuals:
    """Readings of a tile and what its weights leave of them.

    Attributes
    ----------
    basis, weights
        What explains the readings so far.
    readings
        Readings of the tile, map frame, metres and uT.
    noise
        Standard deviation of a reading of weight one in uT.
    """

    basis: Basis
    weights: Weights
    readings: TrainingSet
    noise: float

    def white(self) -> tuple[FloatArray, FloatArray]:
        """Return the whitened residuals (3 N,) and ``F L / sigma`` (3 N, m) of the readings."""
        m, N = len(self.basis), len(self.readings)
        scale = np.repeat(np.sqrt(self.readings.weight) / self.noise, 3)
        half, left = np.empty((3 * N, m)), np.empty(3 * N)
        for at in batches(N):
            F = self.basis.features(self.readings.points[at]).reshape(-1, m)
            rows = slice(3 * at.start, 3 * at.stop)
            left[rows] = self.readings.field[at].ravel() - F @ self.weights.mean
            half[rows] = self.weights.root(F)
        return left * scale, half * scale[:, None]


@dataclass(frozen=True)
class Found:
    """A source that the residuals ask for: where, and how much it gains in nats."""

    position: FloatArray
    gain: float


def residuals_of(
    basis: Basis, readings: TrainingSet, hyperparameters: Hyperparameters
) -> Residuals:
    """Return what a basis leaves of readings."""
    prior = basis.prior(hyperparameters)
    normal = normal_of(basis, readings)
    weights = condition(normal, prior.log_variance, hyperparameters.noise)
    return Residuals(basis, weights, readings, hyperparameters.noise)


class Search:
    """Scores of candidate places against the residuals of one tile.

    Parameters
    ----------
    residuals
        Readings of the tile and what its m weights leave of them, uT.
    """

    def __init__(self, residuals: Residuals) -> None:
        self._left, self._half = residuals.white()
        self._points = residuals.readings.points
        self._scale = np.sqrt(residuals.readings.weight) / residuals.noise

    def gains(self, places: FloatArray) -> FloatArray:
        """Return how many nats a source at each place (K, 3) gains at its best strength, (K,)."""
        K = len(places)
        gains = np.empty(K)
        for start in range(0, K, 64):
            gains[start : start + 64] = self._gains(places[start : start + 64])
        return gains

    def _gains(self, places: FloatArray) -> FloatArray:
        K, m = len(places), self._half.shape[1]
        moments = moment_features(self._points, places) * self._scale[:, None, None]
        # Axis by axis: sums over rows then run along the places.
        Phi = np.ascontiguousarray(moments.reshape(-1, K, 3).transpose(0, 2, 1))
        rows = Phi.reshape(-1, 3 * K)
        seen = (self._half.T @ rows).reshape(m, 3, K)
        q = (self._left @ rows).reshape(3, K)
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


def look_for_sources(
    residuals: Residuals, places: FloatArray, options: SearchOptions
) -> list[Found]:
    """Return the sources of one round: the best of some places (K, 3), apart from each other."""
    points = residuals.readings.points
    search, visited = Search(residuals), cKDTree(points)
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

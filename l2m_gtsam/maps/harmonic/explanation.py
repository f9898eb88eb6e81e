"""Whether a map explains its readings: places held out, and the noise that was learnt."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.evidence import Weights, condition, normal_of
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.local import LocalOptions, local_hyperparameters
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.solve.noise import rms

FOLDS = 4
PATCH = 0.6  # metres; about as far as the space between two lanes of a survey
# Of the errors at held-out readings over what was predicted for them. A normal distribution has a
# spread of 1 and 0.27 % beyond three; in halls whose posts the map did not know of, 3 % and more
# were beyond three, with the posts at most 0.9 %.
MOST_SPREAD = 1.2
MOST_SURPRISES = 0.015
# Of one tile: steel that one place hides must not drown among many that hide none.
MOST_SPREAD_OF_ONE = 2.0
FEWEST_SCORES = 60
FEWEST_PATCHES = 2 * FOLDS
# Learnt noise over the sensor's own: what is not explained counts as noise.
MOST_NOISE = 1.25
FAR_NOISE = 3.0  # of the same: then it is hardly the field
UNCALIBRATED = ": most likely the sensors are not calibrated (`l2m map suite`)"


@dataclass(frozen=True)
class Explanation:
    """How well a map predicts what it has not read.

    Attributes
    ----------
    spread
        Root mean square of held-out readings' errors over what the map predicts for them.
    worst
        The same of the tile where it is largest.
    surprises
        Share of these ratios above three, 0 to 1.
    noise
        Learnt standard deviation of a reading in uT.
    sensor_noise
        That of the sensor's data sheet in uT, if it is known.
    """

    spread: float
    worst: float
    surprises: float
    noise: float
    sensor_noise: float | None

    @property
    def judged(self) -> bool:
        """Return whether there were places enough to hold some out."""
        return not np.isnan(self.spread)

    @property
    def sigmas_hold(self) -> bool:
        """Return whether nothing says that errors are larger than the map states."""
        return not (self.spread > MOST_SPREAD or self.worst > MOST_SPREAD_OF_ONE)

    @property
    def errors_over_stated(self) -> float:
        """How many times what the map states its errors are: 1 where nothing speaks against it."""
        return 1.0 if self.sigmas_hold else max(self.spread, self.worst)

    @property
    def reasons(self) -> list[str]:
        """Return what speaks against the map."""
        reasons = []
        if self.spread > MOST_SPREAD:
            reasons.append(f"errors at held-out places are {self.spread:.2g} times their sigmas")
        elif self.worst > MOST_SPREAD_OF_ONE:
            reasons.append(f"errors in one region are {self.worst:.2g} times their sigmas")
        if self.surprises > MOST_SURPRISES:
            share = f"{self.surprises:.1%} of the errors at held-out places"
            reasons.append(f"{share} exceed three sigmas")
        if self.sensor_noise is not None and self.noise > MOST_NOISE * self.sensor_noise:
            cause = UNCALIBRATED if self.noise > FAR_NOISE * self.sensor_noise else ""
            reasons.append(
                f"the readings' noise is {self.noise:.2g} uT, the sensor's {self.sensor_noise:g}"
                + cause
            )
        return reasons


UNJUDGED = Explanation(float("nan"), float("nan"), float("nan"), float("nan"), None)


@dataclass(frozen=True)
class Patchwork:
    """A basis, its readings, the square of the floor of each, and the fold of each square."""

    basis: Basis
    readings: TrainingSet
    cell: IntArray
    folds: IntArray

    @property
    def fold(self) -> IntArray:
        """Fold of each reading: those of a square are held out together, shape (N,)."""
        return self.folds[self.cell]


def patchwork(basis: Basis, readings: TrainingSet, seed: int) -> Patchwork:
    """Return readings dealt out to folds by squares of the floor."""
    cells = np.floor(readings.points[:, :2] / PATCH).astype(np.int64)
    known, cell = np.unique(cells, axis=0, return_inverse=True)
    dealt = np.random.default_rng(seed).permutation(len(known)) % FOLDS
    return Patchwork(basis, readings, np.asarray(cell, dtype=np.int64), dealt)


def held_out_scores(work: Patchwork, shared: Hyperparameters, local: LocalOptions) -> FloatArray:
    """Return errors at held-out readings over their predicted standard deviations, (3 N,)."""
    parts = [work.readings[np.flatnonzero(work.fold == fold)] for fold in range(FOLDS)]
    parts = [part for part in parts if len(part)]
    normals = [normal_of(work.basis, part) for part in parts]
    total = sum(normals[1:], start=normals[0])
    scores = []
    for part, normal in zip(parts, normals, strict=True):
        # Normal equations add up over readings: leaving a fold out is a subtraction.
        rest = total - normal
        own = local_hyperparameters(work.basis, rest, shared, local)
        weights = condition(rest, work.basis.prior(own).log_variance, own.noise)
        scores.append(scores_of(work.basis, part, weights, own.noise))
    return np.concatenate(scores)


def scores_of(basis: Basis, part: TrainingSet, weights: Weights, noise: float) -> FloatArray:
    """Return the z-scores of readings that the weights do not know, shape (3 N,)."""
    F = basis.features(part.points).reshape(-1, len(basis))
    root = weights.root(F)
    variance = np.repeat(noise**2 / part.weight, 3)
    # A held-out reading errs by the map and by its own noise, independently.
    spread = np.sqrt(np.einsum("nm,nm->n", root, root) + variance)
    return np.asarray((part.field.ravel() - F @ weights.mean) / spread)


def explanation_of(
    works: Sequence[Patchwork],
    shared: Hyperparameters,
    local: LocalOptions,
    sensor_noise: float | None,
) -> Explanation:
    """Return how well the model predicts held-out patches of a few windows."""
    patches = sum(len(np.unique(work.cell)) for work in works)
    if patches < FEWEST_PATCHES:
        return UNJUDGED
    scores = in_threads(lambda work: held_out_scores(work, shared, local), works)
    z = np.concatenate(scores)
    return Explanation(
        spread=rms(z),
        worst=max((rms(each) for each in scores if len(each) >= FEWEST_SCORES), default=0.0),
        surprises=float(np.mean(np.abs(z) > 3)),
        noise=shared.noise,
        sensor_noise=sensor_noise,
    )

"""Learning the hyperparameters: the marginal likelihood of a few windows of the survey."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import COARSE, Basis, basis_of
from l2m_gtsam.maps.harmonic.evidence import Normal, evidence, normal_of
from l2m_gtsam.maps.harmonic.family import BOUNDS, Hyperparameters
from l2m_gtsam.maps.harmonic.local import LocalOptions, local_hyperparameters, moved
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.tiling import (
    FINER,
    Resolution,
    Tiling,
    TilingOptions,
    affordable,
    resolution_of,
    rough_tiles,
    spread_tiles,
    surveyed_area,
    tiling_of,
)
from l2m_gtsam.maps.trained import learning_words
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.options import Options
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.solve.minimum import minimised, on_bound

ROUNDS = 2  # learning is repeated while it asks for finer modes than it looked at
FURTHEST = np.log(300.0)  # from where a search starts
NOISIER = 10.0  # times the usual noise, from where it starts again
BETTER = 1.0  # nats: less is the same maximum


class LearningOptions(Options):
    """The windows of the survey that are looked at."""

    windows: int = Field(default=4, ge=1)
    """Number of windows, spread over the survey."""
    rough: int = Field(default=2, ge=0)
    """Windows where the readings are roughest: the map's waves are as fine as these need."""
    modes: int = Field(default=450, ge=50)
    """About how many modes a window has; smaller windows learn faster."""
    readings: int = Field(default=3000, ge=100)
    """The most readings of one window, drawn at random."""
    seed: int = Field(default=0, ge=0)
    """Seed of the draw."""


@dataclass(frozen=True)
class LearningEnd:
    """How learning ended.

    Attributes
    ----------
    hyperparameters
        Scales in uT and depths in metres of largest likelihood.
    log_likelihood
        Sum over the windows, nats; absent where the hyperparameters were given.
    readings
        Number of readings in all windows.
    converged
        Whether the search ended at a maximum inside the bounds.
    at_bound
        Names of hyperparameters that ended on a bound: the data do not determine them.
    roughest
        Hyperparameters that windows would have by themselves where the readings are roughest.
    """

    hyperparameters: Hyperparameters
    log_likelihood: float | None
    readings: int
    converged: bool
    at_bound: tuple[str, ...]
    roughest: tuple[Hyperparameters, ...] = ()

    @property
    def described(self) -> str:
        """In a few words."""
        if self.log_likelihood is None:
            return "given"
        return learning_words(self.converged, self.at_bound)


@dataclass(frozen=True)
class Window:
    """A piece of the survey whose likelihood is computed exactly."""

    basis: Basis
    normal: Normal


@dataclass(frozen=True)
class Windows:
    """Windows spread over the survey, and some where the readings are roughest."""

    spread: list[Window]
    rough: list[Window]


def learn(
    readings: TrainingSet,
    sources: Sources,
    tiling: TilingOptions,
    share: float,
    options: LearningOptions,
    search: Callable[[Sequence[Window], Hyperparameters], LearningEnd],
) -> LearningEnd:
    """Return the hyperparameters that make the readings most likely.

    Parameters
    ----------
    readings
        Readings of the whole survey, map frame, metres and uT.
    sources
        Candidate sources, map frame, metres.
    tiling
        Overlap and margin around the windows in metres.
    share
        Ratio of variances below which a mode is left out; see ``resolution_of``.
    options
        Number and size of the windows.
    search
        ``maximise``, or ``maximise_again`` for surveys: what is learnt along the path of a drive
        is learnt again as the drive goes on.
    """
    density = float(readings.weight.sum()) / surveyed_area(readings.points)
    guess = starting_point(readings)
    for _ in range(ROUNDS):
        looked_at = affordable(resolution_of(guess, density, share), tiling, options.modes)
        windows = draw_windows(readings, sources, looked_at, tiling, options)
        end = search(windows.spread, guess)
        finest = resolution_of(end.hyperparameters, density, share)
        needed = affordable(finest, tiling, options.modes)
        guess = end.hyperparameters
        # Finer modes than those in the windows would have changed their likelihood.
        if needed.floor < FINER * looked_at.floor and needed.ceiling < FINER * looked_at.ceiling:
            break
    of_map, local = end.hyperparameters, LocalOptions()
    rough = (local_hyperparameters(w.basis, w.normal, of_map, local) for w in windows.rough)
    return replace(end, roughest=tuple(rough))


def starting_point(readings: TrainingSet) -> Hyperparameters:
    """Return where the search starts: what the readings vary by, and sources of usual depth."""
    spread = float(np.sqrt(readings.field.var(axis=0).mean())) + 1e-2
    return Hyperparameters(
        floor_scale=spread, ceiling_scale=0.3 * spread, noise=max(0.03 * spread, 0.05)
    )


def draw_windows(
    readings: TrainingSet,
    sources: Sources,
    resolution: Resolution,
    options: TilingOptions,
    learning: LearningOptions,
) -> Windows:
    """Return windows on the survey."""
    tiling = tiling_of(readings.points, resolution, options, learning.modes, reach=0.0)
    members = tiling.grid.members(readings.points, tiling.overlap)
    rng = np.random.default_rng(learning.seed)

    def window(tile: int) -> Window:
        rows = rng.permutation(members[tile])[: learning.readings]
        return window_of(readings[np.sort(rows)], sources, tiling, tile, resolution)

    spread = spread_tiles(tiling, members, learning.windows)
    rough = rough_tiles(readings, members, learning.rough, spread)
    return Windows([window(tile) for tile in spread], [window(tile) for tile in rough])


def window_of(
    readings: TrainingSet, sources: Sources, tiling: Tiling, tile: int, resolution: Resolution
) -> Window:
    """Return a tile's readings as a window, with every structure in it at the common strength."""
    centre = tiling.grid.centres[tile]
    structures = [sources.pieces[s] for s in sources.within(centre, tiling.edge)]
    even = np.ones(len(structures))
    basis = basis_of(readings, centre, tiling.edge, resolution, structures, even, COARSE)
    return Window(basis, normal_of(basis, readings))


def maximise(
    windows: Sequence[Window], start: Hyperparameters, held: Sequence[str] = ()
) -> LearningEnd:
    """Return the maximum of the windows' summed likelihood, from a start; some may be held."""
    names = [name for name in learnable(windows) if name not in held]
    # Logarithms: all are positive and act by their ratio.
    x0 = np.log([getattr(start, name) for name in names])
    low, high = np.log([BOUNDS[name] for name in names]).T
    low, high = np.maximum(low, x0 - FURTHEST), np.minimum(high, x0 + FURTHEST)

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        trial = moved(start, names, x)
        # Windows count as independent, so that likelihoods add (composite likelihood; Varin, Reid
        # and Firth 2011).
        parts = in_threads(lambda window: log_likelihood(window, trial), windows)
        gradient = np.sum(
            [[part.slopes.get(name, 0.0) for name in names] for part in parts], axis=0
        )
        return -sum(part.value for part in parts), -gradient

    end = minimised(cost, x0, low, high, steps=60, tolerance=1e-6)
    at_bound = tuple(compress(names, on_bound(end.x, low, high)))
    return LearningEnd(
        hyperparameters=moved(start, names, end.x),
        log_likelihood=-float(end.fun),
        readings=sum(window.normal.rows for window in windows) // 3,
        converged=bool(end.success) and not at_bound,
        at_bound=at_bound,
    )


def maximise_again(windows: Sequence[Window], start: Hyperparameters) -> LearningEnd:
    """Return the same; where the search ran into a bound, the likelier of it and of another.

    Where noise is much larger than where a search starts its first steps are long: a side of the
    field then ends as good as not there, where no slope leads back. The other starts from more.
    """
    end = maximise(windows, start)
    if not end.at_bound:
        return end
    other = maximise(windows, start.model_copy(update={"noise": NOISIER * start.noise}))
    gain = (other.log_likelihood or 0.0) - (end.log_likelihood or 0.0)
    return other if gain > BETTER else end


def learnable(windows: Sequence[Window]) -> list[str]:
    """Return the hyperparameters that some window's prior depends on, and the noise."""
    slopes = [window.basis.prior(Hyperparameters()).slopes for window in windows]
    return [name for name in BOUNDS if name == "noise" or any(name in each for each in slopes)]


@dataclass(frozen=True)
class Likelihood:
    """A log likelihood in nats and its slopes by the logarithms of hyperparameters."""

    value: float
    slopes: dict[str, float]


def log_likelihood(window: Window, hyperparameters: Hyperparameters) -> Likelihood:
    """Return how likely a window's readings are."""
    prior = window.basis.prior(hyperparameters)
    result = evidence(window.normal, prior.log_variance, hyperparameters.noise)
    found = result.slopes()
    slopes = {name: float(found.by_log_variance @ slope) for name, slope in prior.slopes.items()}
    return Likelihood(result.value, {**slopes, "noise": found.by_log_noise})

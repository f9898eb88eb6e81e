"""Scales and depths of one tile: steel is not spread evenly under a floor."""

from dataclasses import replace

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.evidence import EvidenceSlopes, Normal, evidence, marginalised
from l2m_gtsam.maps.harmonic.family import BOUNDS, Hyperparameters
from l2m_gtsam.maps.harmonic.modes import Modes
from l2m_gtsam.options import Options

NAMES = ("floor_scale", "floor_depth", "ceiling_scale", "ceiling_depth")
LEAST_GAIN = 1.0  # information of the readings over that of the prior
SCALES = ("floor_scale", "ceiling_scale")
# Where scales rise far above those of the map, more waves become informative: choose them again.
PASSES, RISE = 3, 0.7
SMALL = 0.1  # in the logarithm of a scale or depth: a fraction of its sigma from one tile
LONGEST = 1.5  # of a step in the logarithm of a scale or depth


class LocalOptions(Options):
    """How far a tile's prior may leave the map's."""

    spread: float = Field(default=0.7, ge=0)
    """Standard deviation of the logarithms of a tile's scales and depths about those of the map;
    0 shares them. A floor with bundles of reinforcement here and there is quiet in most tiles and
    strong in some: with one scale for all the map of the simulated warehouse claimed 0.8 of its
    error, with a scale for each tile all of it."""
    steps: int = Field(default=6, ge=1)
    """The most steps of Fisher scoring; three are usual."""


def local_hyperparameters(
    basis: Basis, normal: Normal, shared: Hyperparameters, options: LocalOptions
) -> Hyperparameters:
    """Return the most likely scales and depths of one tile, given those of the map.

    The marginal likelihood of the tile's readings times a log-normal prior about the shared
    values, by Fisher scoring with halved steps where one was too long; noise and the scale of
    structures stay as they are.

    Parameters
    ----------
    basis
        Features of the tile, m weights.
    normal
        Sums over the tile's readings, for m weights.
    shared
        Scales in uT and depths in metres of the map.
    options
        Spread of the prior, and the number of steps.
    """
    found = shared
    for _ in range(PASSES if options.spread > 0 else 0):
        before, found = found, scored(basis, normal, shared, found, options)
        rise = [np.log(getattr(found, name) / getattr(before, name)) for name in SCALES]
        if max(rise) < RISE:
            break
    return found


def scored(
    basis: Basis,
    normal: Normal,
    shared: Hyperparameters,
    start: Hyperparameters,
    options: LocalOptions,
) -> Hyperparameters:
    """Return where Fisher scoring leads from a start, over the waves that are informative there."""
    waves, sums = informative_waves(basis, normal, start)
    slopes = waves.prior(start).slopes
    names = [name for name in NAMES if name in slopes and slopes[name].any()]
    if not names:
        return start
    centre, x = (np.log([getattr(each, name) for name in names]) for each in (shared, start))
    low, high = np.log([BOUNDS[name] for name in names]).T
    best, highest, step = x, -np.inf, np.zeros_like(centre)
    for left in range(options.steps, -1, -1):
        prior = waves.prior(moved(start, names, x))
        found = evidence(sums, prior.log_variance, shared.noise)
        value = found.value - 0.5 * float(np.sum(((x - centre) / options.spread) ** 2))
        if value <= highest:
            step = 0.5 * step
        else:
            best, highest = x, value
            if left:
                by = np.stack([prior.slopes[name] for name in names])
                step = scoring_step(found.slopes(), by, x - centre, options.spread)
        x = np.clip(best + step, low, high)
        if float(np.abs(step).max()) < SMALL:
            return moved(start, names, x)  # so near a maximum it is nearer still
    return moved(start, names, best)


def informative_waves(basis: Basis, normal: Normal, given: Hyperparameters) -> tuple[Basis, Normal]:
    """Return the waves that could be known better than from their prior, and the sums for these.

    Short waves hardly reach the readings. They carry almost no information on scale and depth,
    and are half of all.
    """
    log_variance, waves = basis.prior(given).log_variance, []
    # Ratio of the information on each weight alone to that of its prior.
    kept = np.exp(log_variance) * normal.FF.diagonal() / given.noise**2 > LEAST_GAIN
    for columns, family in zip(basis.columns, basis.families, strict=True):
        if isinstance(family, Modes):
            waves.append(replace(family, numbers=family.numbers[kept[columns]]))
        else:
            kept[columns] = False
    # All else stays as it is: integrated out once, not at each step.
    sums = marginalised(normal, np.flatnonzero(kept), log_variance, given.noise)
    return Basis(basis.frame, tuple(waves)), sums


def scoring_step(
    slopes: EvidenceSlopes, by: FloatArray, away: FloatArray, spread: float
) -> FloatArray:
    """Return the step to where the likelihood, as far as it is quadratic, is largest.

    Parameters
    ----------
    slopes
        Derivatives of the log likelihood by the log prior variances.
    by
        Derivatives of the logarithms of the prior variances by what is sought, shape (p, m).
    away, spread
        How far it is from the middle of its own prior, shape (p,), and the width of that.
    """
    # Expected instead of observed information: positive definite also far from the maximum.
    information = slopes.information(by) + np.eye(len(by)) / spread**2
    step = np.linalg.solve(information, by @ slopes.by_log_variance - away / spread**2)
    return np.asarray(step * min(1.0, LONGEST / max(float(np.abs(step).max()), 1e-300)))


def moved(shared: Hyperparameters, names: list[str], x: FloatArray) -> Hyperparameters:
    """Return hyperparameters with these logarithms of some of them."""
    return shared.model_copy(update=dict(zip(names, np.exp(x).tolist(), strict=True)))

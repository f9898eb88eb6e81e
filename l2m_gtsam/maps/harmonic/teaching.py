"""What readings teach: prior, sources, their strengths, and whether that explains them."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic.basis import COARSE, Basis
from l2m_gtsam.maps.harmonic.dipoles import Dipoles
from l2m_gtsam.maps.harmonic.evidence import (
    Normal,
    evidence,
    inverse_factor_of,
    marginalised,
    normal_of,
    unknown_share,
    whitened_factor,
)
from l2m_gtsam.maps.harmonic.explanation import explanation_of, patchwork
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.learning import LearningEnd, learn, maximise_again
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt, laid_out
from l2m_gtsam.maps.harmonic.search import (
    MOST_READINGS,
    Found,
    Search,
    apart,
    look_for_sources,
    unvisited,
)
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.tiling import rough_tiles, spread_tiles
from l2m_gtsam.maps.training import FEWEST, TrainingSet, merged, survey_doubts
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.solve.minimum import minimised

# Tiles whose held-out places show whether the field is explained, and those of them where the
# readings are roughest.
JUDGED, JUDGED_ROUGH = 12, 4
GROWTH = 1.5  # of the sources, after which the prior is learnt anew
RANGE = (1e-4, 1e3)  # of a strength, relative to the map's structure_scale
# A structure of which the readings determine less than half a weight is no structure.
LEAST_DETERMINED = 0.5
STEPS = 25


def learn_map(raw: TrainingSet, sources: Sources, options: HarmonicOptions) -> Learnt:
    """Return what readings and sources teach.

    Parameters
    ----------
    raw
        Readings in the map frame as they were taken.
    sources
        Candidate positions of steel, map frame, metres.
    options
        Options of the map, lengths in metres.

    Raises
    ------
    MapError
        If no map can be made of the readings.
    """
    readings = merged(raw, options.merge, options.independent)
    if len(readings) < FEWEST:
        raise MapError(
            f"the {len(raw)} map training readings fill {len(readings)} cubes of "
            f"{options.merge:g} m; at least {FEWEST} are needed"
        )
    learnt = learn_once(readings, sources, options)
    if not len(sources) and learnt.origin.explanation.reasons and options.search.rounds > 0:
        learnt = with_search(learnt, options)
    origin = replace(learnt.origin, readings=len(raw), survey=survey_doubts(raw))
    return replace(learnt, origin=origin)


def learn_once(readings: TrainingSet, sources: Sources, options: HarmonicOptions) -> Learnt:
    """Return what readings teach over given sources, and how well that explains them."""
    learning = learn_prior(readings, sources, options)
    plain = laid_out(readings, learning, sources, np.ones(len(sources.pieces)), options)
    return explained(with_strengths(plain), options)


def explained(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same with a verdict from a few of its tiles."""
    members = [learnt.present(tile) for tile in range(len(learnt.tiling))]
    works = []
    spread = spread_tiles(learnt.tiling, members, JUDGED)
    for tile in spread + rough_tiles(learnt.readings, members, JUDGED_ROUGH, spread):
        rows = evenly(members[tile], options.learning.readings)
        basis = learnt.basis(tile, rows, COARSE)
        works.append(patchwork(basis, learnt.readings[rows], options.learning.seed))
    explanation = explanation_of(works, learnt.hyperparameters, learnt.local, options.sensor_noise)
    return replace(learnt, origin=replace(learnt.origin, explanation=explanation))


def evenly(rows: IntArray, most: int) -> IntArray:
    """Return at most so many of the rows, spread evenly."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]


def learn_prior(readings: TrainingSet, sources: Sources, options: HarmonicOptions) -> LearningEnd:
    """Return the hyperparameters that are given, or else those that the readings teach."""
    if options.hyperparameters is not None:
        return LearningEnd(options.hyperparameters, None, 0, converged=True, at_bound=())
    tiling, share = options.tiling, options.mode_share
    return learn(readings, sources, tiling, share, options.learning, maximise_again)


def with_search(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same with sources found round by round in the residuals.

    What is not explained yet counts as noise and hides weaker sources: the prior is learnt anew
    whenever the sources have become half as many again, and when no more are found. Until then a
    tile is looked at again only if sources were found in it.
    """
    readings, current, learnt_with = learnt.readings, learnt, 0
    tiles = list(range(len(learnt.tiling)))
    for _ in range(options.search.rounds):
        found = found_in_tiles(current, tiles, options)
        if not len(found) and len(current.sources) == learnt_with:
            break
        positions = np.concatenate([current.sources.positions, found])
        sources = Sources(positions, np.arange(len(positions)))
        learning = current.origin.learning
        anew = not len(found) or len(positions) >= GROWTH * learnt_with
        if anew:
            learning, learnt_with = learn_prior(readings, sources, options), len(positions)
        current = laid_out(readings, learning, sources, np.ones(len(positions)), options)
        tiles = [
            tile
            for tile, centre in enumerate(current.tiling.grid.centres)
            if anew or Sources(found, np.arange(len(found))).within(centre, current.tiling.edge)
        ]
    searched = replace(current.origin, searched=True)
    return explained(with_strengths(replace(current, origin=searched)), options)


def found_in_tiles(plain: Learnt, tiles: list[int], options: HarmonicOptions) -> FloatArray:
    """Return the places of one round of the search in the cores of tiles, shape (K, 3)."""
    members, grid = plain.members, plain.tiling.grid

    def search(tile: int) -> list[Found]:
        rows = evenly(members[tile], MOST_READINGS)
        basis, readings = plain.basis(tile, rows, COARSE), plain.readings[rows]
        places = unvisited(readings.points, options.search)
        places = places[grid.block_of(places) == tile]
        seen = Search.of(basis, readings, plain.hyperparameters)
        return look_for_sources(seen, places, options.search)

    found = [each for part in in_threads(search, tiles) for each in part]
    # Neighbouring tiles may have seen the same steel.
    kept = apart(found, options.search.apart)
    return np.array([each.position for each in kept]).reshape(-1, 3)


def with_strengths(plain: Learnt) -> Learnt:
    """Return the same with the strength of every structure, learnt in the tile that holds it."""
    middles = plain.sources.middles
    if not len(middles):
        return plain
    home, members = plain.tiling.grid.block_of(middles), plain.members

    def found(tile: int) -> dict[int, float]:
        basis = plain.basis(tile, members[tile], COARSE)
        normal = normal_of(basis, plain.readings[members[tile]])
        near = plain.sources.within(plain.tiling.grid.centres[tile], plain.tiling.edge)
        strengths = learn_strengths(basis, normal, plain.hyperparameters)
        return dict(zip(near, strengths, strict=True))

    strengths = np.zeros(len(plain.strengths))  # of those too far from all tiles
    tiles = np.unique(home).tolist()
    for tile, each in zip(tiles, in_threads(found, tiles), strict=True):
        for structure, strength in each.items():
            if home[structure] == tile:
                strengths[structure] = strength
    return replace(plain, strengths=strengths)


def learn_strengths(basis: Basis, normal: Normal, hyperparameters: Hyperparameters) -> list[float]:
    """Return the strength of each structure among a basis's families, in their order.

    Automatic relevance determination: the marginal likelihood is raised over the logarithm of
    every strength; a structure without evidence shrinks, and is given the strength 0 where the
    readings determine less than half a weight of it.

    Parameters
    ----------
    basis
        With the structures at the strength to start from.
    normal
        Sums over the readings, for m weights.
    hyperparameters
        Scales in uT, depths in metres and noise in uT of the map.
    """
    structures = [
        (np.arange(columns.start, columns.stop), family.strength)
        for columns, family in zip(basis.columns, basis.families, strict=True)
        if isinstance(family, Dipoles)
    ]
    if not structures:
        return []
    kept = np.concatenate([columns for columns, _ in structures])
    owner = np.repeat(np.arange(len(structures)), [len(columns) for columns, _ in structures])
    noise, prior = hyperparameters.noise, basis.prior(hyperparameters).log_variance
    # Floor, ceiling and uniform field stay as they are: integrated out once, not at each step.
    alone, given = marginalised(normal, kept, prior, noise), prior[kept]
    alone = replace(alone, log_weight=normal.log_weight)  # the search ends by shares of it
    start = np.log([strength for _, strength in structures])

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        # A prior variance goes with the square of the strength, hence the factors of two.
        result = evidence(alone, given + 2 * (x - start)[owner], noise)
        slope = np.bincount(owner, result.slopes().by_log_variance).astype(np.float64)
        return -result.value, -2 * slope

    low, high = np.log(RANGE)
    end = minimised(cost, start, low, high, STEPS, 1e-7)
    determined = determined_weights(alone, given + 2 * (end.x - start)[owner], noise)
    # Effective number of weights that the readings determine (MacKay 1992), by structure.
    count = np.bincount(owner, determined)
    return [
        float(np.exp(x)) if c >= LEAST_DETERMINED else 0.0
        for x, c in zip(end.x, count, strict=True)
    ]


def determined_weights(normal: Normal, log_variance: FloatArray, noise: float) -> FloatArray:
    """Return the share of each weight's prior variance that the readings removed, shape (m,)."""
    K = whitened_factor(normal, np.exp(0.5 * log_variance), noise)
    return 1.0 - unknown_share(inverse_factor_of(K))

r"""How far off the sensors of a survey are, as the survey itself tells, where nobody stated it.

Several sensors at one place, or one under several headings, read one field. With r the residuals of
a tile's posterior mean, and E what a unit of each error does to the readings,

.. math::
    I = E^T W (E - F \delta w) / \sigma^2, \qquad u = E^T W r / \sigma^2

are the information and the pull of the errors with the field taken out. All places, all entries of
C, all H and all time offsets have a size each, the most likely one.

Exact sensors pull, too: E holds the gradient of a posterior that was made of these very readings.
By the derivative of the determinant in the marginal likelihood, with the posterior's covariances,

.. math::
    \langle u_k \rangle = -\sum_n \frac{w_n}{\sigma^2} \sum_i
        \mathrm{cov}(\partial B_i, B_i)(x_n) \cdot dx_{nk}
        = -\sum_n \frac{w_n}{2 \sigma^2} \nabla \mathrm{var}(x_n) \cdot dx_{nk}

The variance falls with height above a floor of steel: without this, sensors at different heights
look misplaced by up to a centimetre.

What all sensors have in common says nothing of that. A shift of all is one of the map; and a common
C makes the field smaller, which any prior of a field finds more likely. Sizes are therefore those
of the sensors' differences, and of H as it shows under several headings.

Where it was stated, the survey shows what the errors are.

Errors of several sensors, or of one under several headings, make readings of one place differ. A
prior that is learnt from such readings is rougher, and its noise larger, than those of the field,
and sigmas that follow from both hold neither. With the information I and the pull u of the errors,
the field taken out, and their stated covariance P,

.. math::
    \hat\eta = K u, \qquad K = \Pi (1 + P I)^{-1} P, \qquad
    P' = (1 - K I) P (1 - K I)^T + K I K^T

Readings are corrected by the mean, and the map is learnt anew; P' are the errors that are left, in
all readings alike. The tiles' posterior is that for given errors, so that both together are the
joint posterior.

Only C and H as they differ between sensors, and H as it shows under several headings, are
corrected: the projection :math:`\Pi`. Any prior of a field finds a common C that makes the field
smaller more likely, and exact sensors pull at their places, too. These keep
their covariance and are considered (Schmidt 1966).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import null_space

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.harmonic.error_modes import moved_weights
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.structure import Sources
from l2m_gtsam.maps.harmonic.teaching import learn_map
from l2m_gtsam.maps.harmonic.tiles import TileModes, Tiles
from l2m_gtsam.maps.suite_errors import SIZE, FoundErrors, SuiteErrors
from l2m_gtsam.maps.training import TrainingSet, cubes_of
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.records.error_budget import ErrorCause, StatedSize
from l2m_gtsam.solve.variance_components import WeightSystem

MOST_TILES = 24  # of the survey, spread over it
NAMES = ("t", "C", "H", "offset")
PARTS = np.repeat(np.arange(len(NAMES)), [3, 9, 3, 1])
H = NAMES.index("H")
JUDGED = (NAMES.index("C"), NAMES.index("H"))
SMALLEST = 0.01  # of what was stated
NOTHING = 1e-9  # of a variance: what rounding leaves of none
LEAST_GAIN = 16.0  # twice a logarithm of likelihood; chance gives four sizes that in 0.1 % of maps
# The first map takes the errors for noise and short waves; corrected by half of what they are, the
# second shows them as they are.
PASSES = 2


@dataclass(frozen=True)
class SuiteSizes:
    """Standard deviations of a suite's errors, the same for all of its sensors.

    Attributes
    ----------
    t_m, C, H_ut, offset_s
        Of each coordinate, of each entry, of each axis, of the clocks.
    """

    t_m: float
    C: float
    H_ut: float
    offset_s: float

    @property
    def sigmas(self) -> FloatArray:
        """Of the errors of a sensor, shape (16,)."""
        return np.array([self.t_m, self.C, self.H_ut, self.offset_s])[PARTS]

    @property
    def doubt(self) -> str:
        """What that says of the survey."""
        return (
            "the survey's sensors are off by about "
            f"{1e3 * self.t_m:.1f} mm, {self.C:.2%} of the field, {self.H_ut:.2g} uT and "
            f"{1e3 * self.offset_s:.2g} ms each, by the survey itself: sigmas "
            "include that; calibrate them, and state how well that is known (--suite)"
        )


@dataclass(frozen=True)
class TileView:
    """What the readings of one tile, or of several, say of the sensors' errors.

    Attributes
    ----------
    system
        Information and pull of all of them.
    chance
        Pull that is expected of exact sensors, shape (k,).
    squares
        Sum of squares of the residuals, white by the map's noise.
    """

    system: WeightSystem
    chance: FloatArray
    squares: float


def suite_sizes(learnt: Learnt, tiles: Tiles, suite: SuiteErrors) -> SuiteSizes | None:
    """Return how far off the sensors are; None where the survey shows nothing of it.

    Parameters
    ----------
    learnt, tiles
        Readings and prior of the map, and its tiles.
    suite
        What errors of the sensors do to the readings.
    """
    turned, part = differences(len(suite.sensors))
    spectra = (part == np.arange(len(NAMES))[:, None]).astype(np.float64)
    view = survey_view(learnt, tiles, suite, turned)
    # The map's noise has these errors in it: what they explain is none.
    found = view.system.components_and_noise(spectra, view.squares, view.chance)
    if found.gain < LEAST_GAIN:
        return None
    return SuiteSizes(*np.sqrt(found.sizes).tolist())


def stated_size(learnt: Learnt, tiles: Tiles, suite: SuiteErrors) -> StatedSize | None:
    """Return how large errors of C and H are beside what was stated of them, all alike.

    Places of sensors are not judged: millimetres hardly show.

    Parameters
    ----------
    learnt, tiles, suite
        As in ``suite_sizes``; the covariance is the one stated.
    """
    turned, part = differences(len(suite.sensors))
    variance = np.einsum("ij,ij->j", turned, suite.covariance @ turned)
    apart = np.einsum("ij,i,ij->j", turned, np.diag(suite.covariance), turned)
    known = variance > NOTHING * apart  # sensors may have all of an error in common
    turned, part = turned[:, known], part[known]
    stated = stated_modes(turned.T @ suite.covariance @ turned, np.isin(part, JUDGED))
    judged = stated.judged
    if not judged.any():
        return None
    view = survey_view(learnt, tiles, suite, turned @ stated.root)
    system = view.system.beside((~judged).astype(float)).among(np.flatnonzero(judged))
    alike = np.ones((1, int(judged.sum())))
    found = system.components_and_noise(alike, view.squares)
    gain = found.gain - 2 * system.whiter(found.noise).fit(alike[0]).likelihood
    return StatedSize(ErrorCause.SUITE, max(float(np.sqrt(found.sizes[0])), SMALLEST), gain)


@dataclass(frozen=True)
class StatedModes:
    """Independent numbers of unit variance that make the errors that were stated.

    Attributes
    ----------
    root
        The k errors by the r numbers, shape (k, r).
    judged
        Which of these move the errors that are judged alone, shape (r,).
    """

    root: FloatArray
    judged: BoolArray


def stated_modes(covariance: FloatArray, judged: BoolArray) -> StatedModes:
    """Return what errors of a covariance, (k, k), are made of, those that are judged last.

    Numbers that places and clocks hang on come first: with them C and H move as far as they are
    stated to hang together. The covariance is singular where some sensors are exact.
    """
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    others = np.flatnonzero(~judged)
    first = determined_root(correlation[np.ix_(others, others)])
    # The regression of all errors on these numbers: P_ka L (L^T L)^-1 with P_aa = L L^T.
    carried = correlation[:, others] @ first / np.sum(first**2, axis=0)
    left = correlation - carried @ carried.T
    last = np.flatnonzero(judged)
    rest = determined_root(left[np.ix_(last, last)])
    own = np.zeros((len(judged), rest.shape[1]))
    own[last] = rest
    root = sigma[:, None] * np.hstack([carried, own])
    return StatedModes(root, np.arange(root.shape[1]) >= carried.shape[1])


def determined_root(correlation: FloatArray) -> FloatArray:
    """Return L of full column rank with ``L L^T`` a matrix of correlations, (n, n), orthogonal."""
    values, vectors = np.linalg.eigh(correlation)
    kept = values > NOTHING
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def stated_doubts(learnt: Learnt, tiles: Tiles, suite: SuiteErrors) -> tuple[str, ...]:
    """Return what is wrong with sigmas that were stated of a survey's sensors, a sentence."""
    found = stated_size(learnt, tiles, suite)
    if found is None or not found.is_wrong or (found.ratio < 1 and suite.calibrated_together):
        return ()
    wrong = "too small" if found.ratio > 1 else "too large"
    doubt = (
        f"the sigmas stated of the survey's sensors are {wrong}: by the survey their C and H are "
        f"off by {found.ratio:.2g} times as much, and sigmas of a calibration are {wrong}; correct "
        "them (--suite)"
    )
    return (doubt,)


def survey_view(learnt: Learnt, tiles: Tiles, suite: SuiteErrors, turned: FloatArray) -> TileView:
    """Return what some tiles together say of combinations of the errors, shape (16 S, k)."""
    count = len(learnt.tiling)
    some = np.unique(np.linspace(0, count - 1, min(count, MOST_TILES)).astype(int)).tolist()
    seen = in_threads(lambda index: tile_view(learnt, tiles, suite, index), some)
    information = np.sum([each.system.information for each in seen], axis=0)
    pull = np.sum([each.system.pull for each in seen], axis=0)
    chance = np.sum([each.chance for each in seen], axis=0)
    system = WeightSystem(turned.T @ information @ turned, turned.T @ pull)
    return TileView(system, turned.T @ chance, sum(each.squares for each in seen))


def differences(sensors: int) -> tuple[FloatArray, IntArray]:
    """Return directions of the errors that a survey shows, (16 S, k), and which part each is, (k,).

    Orthonormal, so that errors of one size have that size along each.
    """
    spread = null_space(np.ones((1, sensors)))  # of S sensors, S - 1 differences
    every = dict.fromkeys(range(len(NAMES)), spread) | {H: np.eye(sensors)}
    columns, parts = [], []
    for k, part in enumerate(PARTS.tolist()):
        own = np.zeros((sensors, SIZE, every[part].shape[1]))
        own[:, k] = every[part]
        columns.append(own.reshape(sensors * SIZE, -1))
        parts += [part] * every[part].shape[1]
    return np.concatenate(columns, axis=1), np.array(parts)


def tile_view(learnt: Learnt, tiles: Tiles, suite: SuiteErrors, index: int) -> TileView:
    """Return what one tile says, with the share of its readings that no other tile is made for."""
    tile, rows = tiles[index], learnt.members[index]
    readings, nothing = learnt.readings[rows], np.zeros((3, SIZE * len(suite.sensors)))
    field, gradient = tile.field_and_gradient(readings.points)
    wrong = suite.of_field(rows, gradient)
    moved = TileModes(tile, moved_weights(learnt, suite, index, tile, nothing))
    left = wrong - moved.features(readings.points)
    # Neighbours have readings in common, which must not count twice.
    own = np.mean(learnt.tiling.grid.block_of(readings.points) == index)
    weight = readings.weight * own / tile.hyperparameters.noise**2
    weighted = (wrong * weight[:, None, None]).reshape(-1, wrong.shape[2])
    information = weighted.T @ left.reshape(len(weighted), -1)
    residual = readings.field - field
    system = WeightSystem(0.5 * (information + information.T), weighted.T @ residual.ravel())
    together = tile.gradient_beside_field(readings.points)
    chance = np.einsum("n,nik->k", weight, suite.of_field(rows, gradient + together) - wrong)
    return TileView(system, chance, float(weight @ (residual**2).sum(axis=1)))


def sized(suite: SuiteErrors, sizes: SuiteSizes) -> SuiteErrors:
    """Return errors of a suite with these standard deviations."""
    return replace(suite, covariance=np.diag(np.tile(sizes.sigmas**2, len(suite.sensors))))


def with_errors_found(
    learnt: Learnt, raw: TrainingSet, suite: SuiteErrors, sources: Sources, options: HarmonicOptions
) -> Learnt:
    """Return what readings teach without the errors of their sensors that they show.

    Parameters
    ----------
    learnt
        What the readings teach as they were taken; what speaks against the survey stays.
    raw
        These readings, not merged.
    suite
        What errors of the sensors do to them, with the covariance stated.
    sources
        Candidate positions of steel, map frame, metres.
    options
        Of the map.
    """
    owner, doubts = cubes_of(raw.points, options.merge), learnt.origin.survey
    averaged = suite.averaged(owner, raw.weight)
    mean, every = np.zeros(len(suite.covariance)), np.eye(len(suite.covariance))
    for _ in range(PASSES):
        seen = survey_view(learnt, Tiles(learnt), averaged, every).system
        # The pull of readings as they were taken.
        whole = replace(seen, pull=seen.pull + seen.information @ mean)
        mean, left = considered(whole, suite.covariance, shown(len(suite.sensors)))
        found = FoundErrors(mean, suite.covariance)
        corrected = replace(suite, covariance=left, found=found)
        learnt = learn_map(replace(raw, field=corrected.corrected(raw.field)), sources, options)
    origin = replace(learnt.origin, survey=doubts)
    return replace(learnt, origin=origin, suite=corrected.averaged(owner, raw.weight))


def shown(sensors: int) -> FloatArray:
    """Return the projection on what readings of so many sensors show, shape (16 S, 16 S)."""
    turned, part = differences(sensors)
    own = turned[:, np.isin(part, JUDGED)]
    return np.asarray(own @ own.T)


def considered(
    seen: WeightSystem, P: FloatArray, projection: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of errors of which some are estimated, the others considered.

    Parameters
    ----------
    seen
        What readings say of all n errors.
    P
        Covariance before, shape (n, n).
    projection
        On those that are estimated, shape (n, n).
    """
    information, every = seen.information, np.eye(len(P))
    gain = projection @ np.linalg.solve(every + P @ information, P)
    kept = every - gain @ information
    left = kept @ P @ kept.T + gain @ information @ gain.T
    return gain @ seen.pull, 0.5 * (left + left.T)

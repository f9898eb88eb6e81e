r"""How wrong the poses of a survey are, as the survey itself tells, where nobody stated it.

Passes that cross read one field. Where they differ by more than the noise of a reading, and for
longer than a moment, poses were wrong. With r the residuals of a tile's posterior mean, and E what
a unit of each error at a knot does to the readings,

.. math::
    I = E^T W (E - F \delta w) / \sigma^2, \qquad u = E^T W r / \sigma^2

are information and pull with the field taken out, and with it the errors of the survey's sensors as
far as these are known. Tilt, heading, place on the floor and height have a size each, the most
likely one for a few tiles together; how long errors last is one of a few times.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.basis import COARSE
from l2m_gtsam.maps.harmonic.evidence import condition, normal_of
from l2m_gtsam.maps.harmonic.learning import Window, maximise
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.tile_sums import shared_noise
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.harmonic.tiling import spread_tiles
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.parallel.threads import in_threads
from l2m_gtsam.solve.linear_algebra import covariance_root
from l2m_gtsam.solve.variance_components import (
    VarianceComponents,
    WeightSystem,
    noise_left,
    shared_components,
)

MOST_TILES = 4  # of the survey, spread over it
MOST_READINGS = 150  # of a tile, those nearest to its middle
PARTS = np.array([0, 0, 1, 2, 2, 3])  # tilt, heading, floor, height: of each of the six errors
LASTING_S = (2.0, 1.0, 4.0)  # the first tells which parts there are
LEAST_GAIN = 16.0  # twice a logarithm of likelihood, as for the survey's sensors
# Of it, outside the tile that has most. Beside strong steel a tile leaves residuals that a height
# explains: in three of forty halls with exact poses one tile had 15 to 20, the others together at
# most 5.
LEAST_ELSEWHERE = 8.0
# Of rotations in rad and translations in m. A map of steel that it does not know of asks for more.
MOST = np.repeat([np.deg2rad(5.0), 0.1], 3)
LEAST_SHARE = 0.03  # of the noise's variance: what does less to a reading is not worth a column


@dataclass(frozen=True)
class FoundPoses:
    """Errors of the poses of a survey, and the noise beside them.

    Attributes
    ----------
    sizes
        Standard deviations of the six errors in rad and m, shape (6,).
    lasting_s
        How long they last.
    noise
        Share of the noise's variance that is left beside them.
    gain
        Twice the logarithm of the likelihood beyond that of exact poses.
    """

    sizes: FloatArray
    lasting_s: float
    noise: float
    gain: float

    @property
    def credible(self) -> bool:
        """Whether poses can be as wrong as that; else a field that no wave makes looks like it."""
        return bool((self.sizes < MOST).all())

    @property
    def doubt(self) -> str:
        """What that says of the survey."""
        tilt, heading = np.rad2deg(self.sizes[[0, 2]]).tolist()
        floor, height = (1e3 * self.sizes[[3, 5]]).tolist()
        return (
            f"the survey's poses are off by about {tilt:.2g} deg of tilt, {heading:.2g} deg of "
            f"heading, {floor:.2g} mm on the floor and {height:.2g} mm of height for "
            f"{self.lasting_s:g} s, by the survey itself: sigmas include that; state how wrong "
            "they are if it is known (mapping.pose_noise)"
        )


@dataclass(frozen=True)
class PoseView:
    """What some readings of a tile say of the poses' errors.

    Attributes
    ----------
    system
        Information and pull of the errors at all knots.
    part
        Which of ``PARTS`` each is, shape (q,).
    squares
        Sum of squares of the residuals, white by the map's noise.
    by_unit
        Mean variance of a reading by a unit of each part, uT^2, shape (4,).
    """

    system: WeightSystem
    part: IntArray
    squares: float
    by_unit: FloatArray

    def among(self, parts: IntArray) -> "PoseView":
        """Return the same for some parts, the others being zero."""
        at = np.flatnonzero(np.isin(self.part, parts))
        return replace(self, system=self.system.among(at), part=self.part[at])


def pose_sizes(
    learnt: Learnt, tiles: Tiles, poses: SurveyPoses, *, noise_known: bool = False
) -> FoundPoses | None:
    """Return how wrong the poses are; None where the survey shows nothing of it.

    Parameters
    ----------
    learnt, tiles
        Readings and prior of the map, and its tiles, for exact poses.
    poses
        What a unit of each error does to the readings.
    noise_known
        Whether the map's noise is that of readings beside these errors; else it has them in it.
    """

    def seen(unit: FloatArray, lasting_s: float) -> list[PoseView]:
        return pose_views(learnt, tiles, poses.sized(unit, lasting_s))

    return most_likely(seen, learnt.hyperparameters.noise, noise_known=noise_known)


def most_likely(
    seen: Callable[[FloatArray, float], list[PoseView]], noise: float, *, noise_known: bool = False
) -> FoundPoses | None:
    """Return the most likely errors of poses; None where no more than one place shows any.

    Parameters
    ----------
    seen
        Returns what places, each by itself, say of errors of a unit each, zero for those that are
        left out, shape (6,), which last so many seconds.
    noise
        Of a reading in uT.
    noise_known
        As of ``pose_sizes``.
    """
    parts = np.unique(PARTS)
    found: list[tuple[FoundPoses, float]] = []
    for lasting_s in LASTING_S:
        views = seen(np.isin(PARTS, parts).astype(np.float64), lasting_s)
        if not found:  # of these parts, those that matter
            sizes = likely(views, parts, known=noise_known).sizes
            variance = np.mean([each.by_unit for each in views], axis=0) * sizes
            parts = np.flatnonzero(variance > LEAST_SHARE * noise**2)
            if not len(parts):
                return None
            views = [each.among(parts) for each in views]
        fit = likely(views, parts, known=noise_known)
        sized = FoundPoses(np.sqrt(fit.sizes)[PARTS], lasting_s, fit.noise, fit.gain)
        found.append((sized, gain_elsewhere(views, fit)))
    best, elsewhere = max(found, key=lambda each: each[0].gain)
    shown = best.gain > LEAST_GAIN and elsewhere > LEAST_ELSEWHERE
    return best if shown and best.credible else None


def gain_elsewhere(views: Sequence[PoseView], fit: VarianceComponents) -> float:
    """Return the gain of all places but the one that has most; of a single one its own."""
    gains = [
        2 * each.system.whiter(fit.noise).fit(fit.sizes[each.part]).likelihood for each in views
    ]
    return fit.gain - max(gains) if len(gains) > 1 else fit.gain


def gain_as_stated(seen: Sequence[PoseView]) -> float:
    """Return the logarithm of likelihood of stated errors that last, beyond that of exact poses."""
    return sum(each.system.fit(np.ones(len(each.part))).likelihood for each in seen)


def noise_beside(seen: Sequence[PoseView]) -> float:
    """Return the share of the noise's variance that is left beside errors of stated sizes."""
    return noise_left(
        [each.system for each in seen],
        [np.ones(len(each.part)) for each in seen],
        sum(each.squares for each in seen),
    )


def likely(views: Sequence[PoseView], parts: IntArray, *, known: bool) -> VarianceComponents:
    """Return the most likely variances of all parts, of which only some may differ from zero."""
    spectra = [np.array([each.part == part for part in parts], dtype=float) for each in views]
    squares = None if known else sum(each.squares for each in views)
    found = shared_components([each.system for each in views], spectra, squares)
    sizes = np.zeros(PARTS.max() + 1)
    sizes[parts] = found.sizes
    return replace(found, sizes=sizes)


def pose_views(learnt: Learnt, tiles: Tiles, poses: SurveyPoses) -> list[PoseView]:
    """Return what some tiles, each by itself, say of the errors of poses."""
    some = spread_tiles(learnt.tiling, learnt.members, MOST_TILES)
    return in_threads(partial(pose_view, learnt, tiles, poses), some)


def pose_view(learnt: Learnt, tiles: Tiles, poses: SurveyPoses, index: int) -> PoseView:
    """Return what the readings in the middle of a tile say."""
    tile, own = tiles[index], middle(learnt, index)
    # The tile holds what errors of the sensors do to all of its readings.
    rows = own if learnt.suite is None else learnt.members[index]
    at, readings = np.searchsorted(rows, own), learnt.readings[rows]
    field, gradient = tile.field_and_gradient(readings.points)
    effects = poses.knots(own, gradient[at])
    part, count = PARTS[effects.part], len(effects.part)
    errors = np.zeros((len(rows), 3, count))
    errors[at] = effects.white
    by_unit = np.square(errors[at]).mean(axis=(0, 1))
    if learnt.suite is not None:  # those of the sensors explain what they can
        root = covariance_root(learnt.suite.covariance)
        errors = np.concatenate([errors, learnt.suite.of_field(rows, gradient) @ root], axis=2)
    root_weight = np.sqrt(readings.weight)[:, None, None] / tile.hyperparameters.noise
    E = (errors * root_weight).reshape(-1, errors.shape[2])
    F = (tile.basis.features(readings.points) * root_weight).reshape(len(E), -1)
    r = (readings.field - field)[:, :, None] * root_weight
    white = np.ascontiguousarray((F.T @ E) * tile.weights.prior_sigma[:, None])
    tile.weights.factor.solve_rows(white)
    information = E.T @ E - white.T @ white
    system = WeightSystem(0.5 * (information + information.T), E.T @ r.ravel())
    beside = np.arange(len(information)) >= count
    if beside.any():
        system = system.beside(beside.astype(float)).among(np.arange(count))
    by_part = np.array([by_unit[part == each].sum() for each in np.unique(PARTS)])
    return PoseView(system, part, float(np.square(r[at]).sum()), by_part)


def middle(learnt: Learnt, index: int) -> IntArray:
    """Return the readings nearest to the middle of a tile, sorted."""
    rows = learnt.members[index]
    away = np.linalg.norm(
        learnt.readings.points[rows, :2] - learnt.tiling.grid.centres[index], axis=1
    )
    return np.sort(rows[np.argsort(away)[:MOST_READINGS]])


TURNS = 2  # of sizes, then scales


def with_pose_errors(
    learnt: Learnt, tiles: Tiles, poses: SurveyPoses, options: HarmonicOptions
) -> Learnt | None:
    """Return a map's prior with errors of its poses; None where nothing shows or states any.

    Parameters
    ----------
    learnt, tiles
        For exact poses.
    poses
        What errors do to the readings: a unit of each, or those that are stated.
    options
        Of the map.
    """
    if poses.stated:
        seen = pose_views(learnt, tiles, poses)
        # Errors that every pose has of its own are noise of each reading, which a map has learnt.
        if not poses.duration_stated and not gain_as_stated(seen) > 0:
            return None
        return relearnt(replace(quieter(learnt, noise_beside(seen)), poses=poses), options)
    if options.hyperparameters is not None:  # with the noise that is given there is nothing to find
        return None
    found, current = pose_sizes(learnt, tiles, poses), learnt
    if found is None:
        return None
    for _ in range(TURNS - 1):
        current = relearnt(beside(current, poses, found), options)
        exact = replace(current, poses=None)
        again = pose_sizes(exact, Tiles(exact), poses, noise_known=True)
        if again is None:  # scales that fit better leave nothing of them
            return None
        found = again
        current = exact
    done = beside(current, poses, found)
    survey = (*done.origin.survey, found.doubt)
    return replace(done, origin=replace(done.origin, survey=survey))


def beside(learnt: Learnt, poses: SurveyPoses, found: FoundPoses) -> Learnt:
    """Return the same with errors of poses; what they explain is no noise."""
    sized = poses.sized(found.sizes, found.lasting_s)
    return replace(quieter(learnt, found.noise), poses=sized)


def quieter(learnt: Learnt, share: float) -> Learnt:
    """Return the same with a share of the noise's variance."""
    of_map = learnt.hyperparameters
    quiet = of_map.model_copy(update={"noise": float(of_map.noise * share**0.5)})
    return replace(learnt, hyperparameters=quiet)


def relearnt(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same with scales and depths learnt beside the errors of the poses."""
    if options.hyperparameters is not None:
        return learnt
    some = spread_tiles(learnt.tiling, learnt.members, options.learning.windows)
    end = maximise([window(learnt, tile) for tile in some], learnt.hyperparameters, ("noise",))
    return replace(learnt, hyperparameters=end.hyperparameters)


def window(learnt: Learnt, tile: int) -> Window:
    """Return a tile's readings beside the errors of their poses."""
    rows = learnt.members[tile]
    basis, readings = learnt.basis(tile, rows, COARSE), learnt.readings[rows]
    given = learnt.hyperparameters
    plain = condition(normal_of(basis, readings), basis.prior(given).log_variance, given.noise)
    _, gradient = basis.field_and_gradient(readings.points, plain.mean)
    return Window(basis, normal_of(basis, readings, shared_noise(learnt, rows, gradient)))

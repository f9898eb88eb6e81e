r"""Sources that explain what readings differ from a map by.

A source is looked for on a coarse grid, where its moment is linear: with the precision P of the
readings, D the field of unit moments, ``F = D^T P D`` and ``g = D^T P e``, it explains
``g^T F^{-1} g``, twice the logarithm of the likelihood ratio. The best one is refined together with
all that were found before, and stays if it explains more than its parameters do by chance.

It is a dipole, a bar that stands or one that lies, and has to earn each of its parameters (Schwarz
1978): what is not found yet looks like the length of a bar as well. With all sources found, each
one's shape is decided again by its evidence. What a length costs then is how much narrower readings
make it than it was beforehand, so that a length which they leave open stays open, and widens the
sigma of the moment.
"""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.maps.harmonic.dipoles import moment_features
from l2m_gtsam.maps.sources.found_sources import FoundSources, nothing_found, price, refined
from l2m_gtsam.maps.sources.marginal import AXES, MarginalRows
from l2m_gtsam.maps.sources.source import UT_M3, SourceShape
from l2m_gtsam.options import Options

BATCH = 128  # candidates that are asked together
REACH_M = 4.0  # of a source: what it adds further away changes nothing
# Between candidates a source explains more than at the best of them: not three times as much.
HOPELESS = 0.4  # of the price
DIPOLE = 6  # parameters
STARTS = 3  # dipoles that the descent is begun from
MOST_WRONG = 20  # readings; with more of them it is not single ones that are wrong
FIRST_HALF_M = (0.3, 0.8)  # where the length of a bar is started, near a dipole and elsewhere
# Bars stand upright or lie: components of the axis that are zero stay so.
STANDING = np.array([[0.0, 0.0, 1.0]])
LYING = np.array([[0.92, 0.39, 0.0], [-0.39, 0.92, 0.0]])
NO_LENGTH = np.zeros((1, 3))
ROUNDS = 3  # of deciding on all shapes: sources beside each other share a field
BARE_MENTION = 2.0  # evidence that is not worth more (Kass and Raftery 1995, 3.2)


class SourceSearchOptions(Options):
    """How sources are looked for that changed since a place was mapped."""

    most: int = Field(default=8, ge=0)
    """The most of them in a drive; 0 looks for none."""
    spacing: float = Field(default=0.35, gt=0.05, le=2)
    """Distance of the places that are tried first, metres."""
    reach: float = Field(default=2.5, gt=0, le=10)
    """Up to where from the readings sources are looked for, metres."""
    nearest: float = Field(default=0.2, gt=0, le=2)
    """Steel is no nearer to a sensor than this, metres."""
    heights: tuple[float, ...] = (-0.4, 0.1, 0.6, 1.2, 2.0)
    """Heights over the sensors that are tried first, metres."""


def find_sources(
    rows: MarginalRows,
    suspected: FloatArray,
    options: SourceSearchOptions,
    known: FoundSources | None,
) -> FoundSources:
    """Return the sources that explain what readings differ from the map by.

    Parameters
    ----------
    rows
        Averaged readings.
    suspected
        Places near which sources may be, metres, shape (M, 3).
    options
        How to look for them.
    known
        Where to begin: sources that were found before, if any.
    """
    found, wrong = apart(rows, known.shapes if known else (), options), list[int]()
    grid = SourcePlaces.over(rows, suspected, options)
    trials = 2 * float(np.log(max(len(grid), 1)))  # Bonferroni, on the scale of the gain
    while len(found) < options.most and len(grid):
        starts = grid.starts(rows, rows.residual - found.field(rows.points))
        if starts.gain < HOPELESS * price(rows, DIPOLE):
            break
        better = best_of(rows, found, starts.shapes)
        least = price(rows, better.parameters - found.parameters) + trials
        if found.left - better.left < least:
            break
        field, _ = better.shapes[-1].field_and_gradient(rows.points)
        beside = rows.residual - better.field(rows.points) + field
        alone = wrong_reading(rows, beside, field, least, price(rows, AXES))
        if alone is not None and len(wrong) < MOST_WRONG:
            # What was known of moments on the grid without it is a little too much; it begins only.
            rows = rows.without([alone])
            wrong.append(alone)
            found = refined(rows, found.shapes)
            continue
        if alone is not None or too_near(better, rows, options):
            break
        found = better
    found = pruned(rows, reshaped(rows, found), trials)
    return replace(found, wrong=tuple(wrong))


@dataclass(frozen=True)
class Starts:
    """Dipoles to begin with, the best first, and what that one explains where it stands."""

    shapes: list[SourceShape]
    gain: float


@dataclass(frozen=True)
class SourcePlaces:
    """Places where a source may be, with what the readings know of a moment there.

    Attributes
    ----------
    positions
        Metres, shape (C, 3).
    information
        Of each one's moment in (A m^2)^-2, shape (C, 3, 3).
    """

    positions: FloatArray
    information: FloatArray

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def over(
        cls, rows: MarginalRows, suspected: FloatArray, options: SourceSearchOptions
    ) -> "SourcePlaces":
        """Return the candidates within reach of suspected places."""
        positions = candidates(rows.points, suspected, options)
        information = np.empty((len(positions), 3, 3))
        tree = cKDTree(rows.points)
        order = by_block(positions)
        for part in np.array_split(order, max(1, -(-len(order) // BATCH))):
            if not len(part):
                continue
            at = positions[part]
            within = np.zeros(len(rows), dtype=np.bool_)
            within[
                np.concatenate([np.array(q, dtype=int) for q in tree.query_ball_point(at, REACH_M)])
            ] = True
            own = rows.near(within)
            white = own.whitened(UT_M3 * moment_features(own.points, at))
            seen = own.projected(white)
            for each, k in zip(part, range(len(part)), strict=True):
                w, s = white[:, 3 * k : 3 * k + 3], seen[:, 3 * k : 3 * k + 3]
                information[each] = w.T @ w - s.T @ s
        return cls(positions, information)

    def starts(self, rows: MarginalRows, residual: FloatArray) -> Starts:
        """Return the dipoles that explain most of residuals in uT, shape (N, 3), the best first."""
        pulled, _ = rows.pull(residual)
        g = np.empty((len(self), 3))
        for part in np.array_split(np.arange(len(self)), max(1, -(-len(self) // BATCH))):
            unit = UT_M3 * moment_features(rows.points, self.positions[part])
            g[part] = np.einsum("nim,ni->m", unit, pulled).reshape(-1, 3)
        size = np.trace(self.information, axis1=1, axis2=2)[:, None, None]
        F = self.information + 1e-9 * size * np.eye(3)
        moments = np.linalg.solve(F, g[:, :, None])[:, :, 0]
        gains = np.einsum("ki,ki->k", g, moments)
        order = np.argsort(-gains)
        chosen: list[int] = []
        for k in order:  # apart from each other: neighbours descend to the same optimum
            apart = all(np.linalg.norm(self.positions[k] - self.positions[j]) > 0.8 for j in chosen)
            if apart:
                chosen.append(int(k))
            if len(chosen) == STARTS:
                break
        shapes = [SourceShape.dipole(self.positions[k], moments[k]) for k in chosen]
        return Starts(shapes, float(gains.max()))


def candidates(
    points: FloatArray, suspected: FloatArray, options: SourceSearchOptions
) -> FloatArray:
    """Return places within reach of suspected ones and not nearer to readings than steel is."""
    if not len(suspected):
        return np.empty((0, 3))
    low, high = (f(suspected[:, :2], axis=0) for f in (np.min, np.max))
    x, y = (
        np.arange(
            low[k] - options.reach, high[k] + options.reach + options.spacing, options.spacing
        )
        for k in (0, 1)
    )
    flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    away, at = cKDTree(suspected[:, :2]).query(flat)
    within = np.asarray(away) <= options.reach
    levels = np.array(options.heights)
    z = suspected[np.asarray(at)[within], 2][:, None] + levels
    flat = flat[within]
    every = np.concatenate([np.repeat(flat, len(levels), axis=0), z.reshape(-1, 1)], axis=1)
    near, _ = cKDTree(points).query(every)
    return np.asarray(every[near >= options.nearest])


def by_block(positions: FloatArray) -> IntArray:
    """Return the order of places in which those of one square of 2 m follow each other."""
    cell = np.floor(positions[:, :2] / 2.0).astype(np.int64)
    return np.asarray(np.lexsort((cell[:, 1], cell[:, 0])))


def pruned(rows: MarginalRows, found: FoundSources, trials: float) -> FoundSources:
    """Return the sources that explain enough which the others do not, with how much that is.

    The others may take other shapes: a dipole beside a dipole is often the length of a bar.
    """
    while len(found):
        without = [
            refined(rows, found.shapes[:k] + found.shapes[k + 1 :]) for k in range(len(found))
        ]
        gains = np.array([each.left - found.left for each in without])
        least = without[int(np.argmin(gains))]
        fewer = reshaped(rows, least)
        earned = price(rows, DIPOLE - fewer.parameters + least.parameters) + trials
        if fewer.left - found.left >= earned:
            return replace(found, gains=gains)
        found = fewer
    return nothing_found(rows)


def apart(
    rows: MarginalRows, shapes: tuple[SourceShape, ...], options: SourceSearchOptions
) -> FoundSources:
    """Return the most likely sources near some, without those that end where a sensor was."""
    found = refined(rows, shapes)
    while too_near(found, rows, options):
        nearest = int(np.argmin(away(found, rows)))
        found = refined(rows, found.shapes[:nearest] + found.shapes[nearest + 1 :])
    return found


def too_near(found: FoundSources, rows: MarginalRows, options: SourceSearchOptions) -> bool:
    """Return whether a source lies where a sensor was."""
    return bool((away(found, rows) < 0.5 * options.nearest).any())


def away(found: FoundSources, rows: MarginalRows) -> FloatArray:
    """Return the distance of the nearest reading to each source, metres, shape (K,)."""
    places = np.array([each.position for each in found.shapes]).reshape(-1, 3)
    return np.asarray(cKDTree(rows.points).query(places)[0])


def wrong_reading(
    rows: MarginalRows, residual: FloatArray, field: FloatArray, least: float, price: float
) -> int | None:
    """Return the reading that is wrong where that explains what a source does; none otherwise.

    Both are judged by what they explain less what they have to. If one wrong reading is the better
    explanation, the source has to explain enough beside it.

    Parameters
    ----------
    rows
        N readings.
    residual
        What they differ by from all but the source, uT, shape (N, 3).
    field
        The source's, as it was fitted, uT, shape (N, 3).
    least
        What the source has to explain.
    price
        What as many parameters as a reading has axes have to; that there are as many readings to
        choose from is added here.
    """
    pulled, _ = rows.pull(residual)
    most = int(np.argmax(np.einsum("ni,ni->n", field, pulled)))
    features = np.zeros((len(rows), AXES, 1 + AXES))
    features[:, :, 0], features[most, :, 1:] = field, np.eye(AXES)
    F, g = rows.information(features), np.einsum("nim,ni->m", features, pulled)
    source = g[0] ** 2 / F[0, 0]
    reading = float(g[1:] @ np.linalg.solve(F[1:, 1:], g[1:]))
    # Elsewhere the source may change hardly any reading: then both explain the same.
    both = float(g @ np.linalg.lstsq(F, g, rcond=1e-10)[0])
    worth = reading - price - 2 * float(np.log(len(rows)))
    return most if worth > source - least and both - reading < least else None


def best_of(rows: MarginalRows, found: FoundSources, starts: list[SourceShape]) -> FoundSources:
    """Return the best refinement of sources and one more, a dipole or a bar."""
    dipole = min((refined(rows, (*found.shapes, each)) for each in starts), key=_left)
    best, before = dipole, (*dipole.shapes[:-1],)
    for axes in (STANDING, LYING):
        near, elsewhere = FIRST_HALF_M
        bars = [
            refined(rows, (*before, dipole.shapes[-1].with_half_axis(near * axis))) for axis in axes
        ]
        bars += [
            refined(rows, (*found.shapes, starts[0].with_half_axis(elsewhere * axis)))
            for axis in axes
        ]
        bar = min(bars, key=_left)
        if best.left - bar.left > price(rows, bar.parameters - best.parameters):
            best = bar
    return best


def reshaped(rows: MarginalRows, found: FoundSources) -> FoundSources:
    """Return the same sources, each with the shape that has most evidence beside the others."""
    for _ in range(ROUNDS):
        before = found
        for k in range(len(found)):
            other = max(_of_other_shapes(rows, found, k), key=_evidence)
            found = other if other.evidence > found.evidence + BARE_MENTION else found
        if found is before:
            break
    return found


def _of_other_shapes(rows: MarginalRows, found: FoundSources, k: int) -> list[FoundSources]:
    """Return sources of which one has another shape than it has."""
    half_axis = found.shapes[k].half_axis
    shape_of_now = STANDING if half_axis[2] else LYING if half_axis.any() else NO_LENGTH
    others = [axes for axes in (NO_LENGTH, STANDING, LYING) if axes is not shape_of_now]
    start = FIRST_HALF_M[0] * np.concatenate(others)
    shapes = found.shapes
    return [
        refined(rows, (*shapes[:k], shapes[k].with_half_axis(each), *shapes[k + 1 :]))
        for each in start
    ]


def _left(found: FoundSources) -> float:
    return found.left


def _evidence(found: FoundSources) -> float:
    return found.evidence

"""The readings that a map is trained on: checked, thinned, and with the errors that they share.

What is wrong with a survey shows as far as its readings do, whatever map is made of them.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.suite_errors import SuiteErrors
from l2m_gtsam.maps.survey_poses import SurveyPoses
from l2m_gtsam.options import Options

FEWEST = 10
FURTHEST = 1e8  # metres from the origin of the map, where float64 still holds a micrometre
STRONGEST = 1e6  # microtesla, one tesla
LEAST_EXTENT = 0.01  # metres
LEAST_CUBES = 10  # along the longest side, so that thinning never eats a small data set
NARROW = 0.1  # metres; a drive this close to one line does not determine the field beside it
SAME_PLACE = 0.05  # metres; edge of a cube in which all readings should agree
# In microtesla, beside what the field changes by from reading to reading there.
DISAGREE = 10.0
# How many times as steep as along the path a field may be across it: beside a pole it falls
# outwards by twice what it rises sideways, as its divergence is zero.
STEEPER = 2.0
# Twice the strongest field of the Earth, in microtesla.
STRONG = 130.0
FEW = 0.01  # of the readings; single spikes are no reason to doubt a survey


class ThinningOptions(Options):
    """How readings that lie close together are merged."""

    spacing: float = Field(default=0.15, ge=0, le=1)
    """Edge, in length scales, of the cubes over which readings are averaged; 0 keeps them all.
    On smooth fields a third is as accurate with half the rows; beside steel posts it doubles the
    error (0.21 against 0.11 uT in the simulated warehouse)."""

    independent: int = Field(default=10, ge=1)
    """The most readings of one cube that count as independent: their errors share the pose and
    the disturbances of one passage, so that a vehicle at rest must not count a thousand fold."""


@dataclass(frozen=True)
class TrainingSet:
    """Positions and readings in the map frame.

    Attributes
    ----------
    points
        Positions in metres, shape (N, 3).
    field
        Readings in microtesla, shape (N, 3).
    weight
        How many independent readings each row is worth, shape (N,): the variance of its noise is
        that of one reading divided by it.
    """

    points: FloatArray
    field: FloatArray
    weight: FloatArray

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: IntArray) -> "TrainingSet":
        return TrainingSet(self.points[rows], self.field[rows], self.weight[rows])

    @cached_property
    def tree(self) -> cKDTree:
        """The positions, to be looked up."""
        return cKDTree(self.points)

    @property
    def mean(self) -> FloatArray:
        """Mean of the rows per axis in microtesla, shape (3,)."""
        return np.asarray(self.field.mean(axis=0))


def checked_points(points: FloatArray) -> FloatArray:
    """Return points as float64 after checking that they are finite and of shape (N, 3).

    Raises
    ------
    MapError
        If they are not.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MapError(f"map points have shape {points.shape}; (N, 3) is needed")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise MapError(f"map point {int(bad.argmax())} of {len(points)} is not finite")
    return points


def checked_readings(
    points: FloatArray, field: FloatArray, weight: FloatArray | None = None
) -> TrainingSet:
    """Return readings after checking each of them; there may be none. See ``training_set``."""
    points = checked_points(points)
    field = np.asarray(field, dtype=np.float64)
    weight = np.ones(len(points)) if weight is None else np.asarray(weight, dtype=np.float64)
    if field.shape != points.shape or weight.shape != points.shape[:1]:
        raise MapError(
            f"map training readings have shape {field.shape} and weights {weight.shape}; "
            f"{len(points)} points need {points.shape} and {points.shape[:1]}"
        )
    bad = ~(np.isfinite(field).all(axis=1) & np.isfinite(weight) & (weight > 0))
    if bad.any():
        raise MapError(
            f"map training reading {int(bad.argmax())} of {len(points)} is not finite and of "
            "positive weight"
        )
    if np.abs(points).max(initial=0.0) > FURTHEST:
        raise MapError(f"map training positions exceed {FURTHEST:g} m: are they in metres?")
    if np.abs(field).max(initial=0.0) > STRONGEST:
        raise MapError(f"map training readings exceed {STRONGEST:g} uT: are they in microtesla?")
    return TrainingSet(points, field, weight)


def training_set(
    points: FloatArray, field: FloatArray, weight: FloatArray | None = None
) -> TrainingSet:
    """Return readings as a training set after checking that a map can be made from them.

    Parameters
    ----------
    points
        Positions in the map frame in metres, shape (N, 3).
    field
        Readings in the map frame in microtesla, shape (N, 3).
    weight
        How many independent readings each row is worth, shape (N,); one by default.

    Raises
    ------
    MapError
        If shapes disagree, a value is not finite, or there is too little to make a map from.
    """
    readings = checked_readings(points, field, weight)
    if len(readings) < FEWEST:
        raise MapError(f"a map needs at least {FEWEST} training readings, got {len(readings)}")
    if np.ptp(readings.points, axis=0).max() < LEAST_EXTENT:
        raise MapError("all map training readings were taken at one point; a drive is needed")
    return readings


def additional_set(points: FloatArray, field: FloatArray) -> TrainingSet:
    """Return readings that a map is given more of; few will do, and a vehicle at rest.

    Parameters
    ----------
    points
        Positions in the map frame in metres, shape (N, 3).
    field
        Readings in the map frame in microtesla, shape (N, 3).

    Raises
    ------
    MapError
        If shapes disagree, a value is not finite, or there is no reading.
    """
    readings = checked_readings(points, field)
    if not len(readings):
        raise MapError("there are no readings to add to the map; at least one is needed")
    return readings


def thinned(readings: TrainingSet, length_scale: float, options: ThinningOptions) -> TrainingSet:
    """Return the readings averaged over the cubes of a grid.

    Position and field are averaged alike, so what a cube loses is the curvature of the field
    within it: for an edge of a third of the length scale, about 0.01 of the signal.

    Parameters
    ----------
    readings
        Readings; those of a map that is given more of them have been averaged before.
    length_scale
        Length scale of the kernel in metres.
    options
        Edge of the cubes and the most that one is worth.
    """
    if options.spacing == 0.0:
        return readings
    extent = float(np.ptp(readings.points, axis=0).max())
    edge = min(options.spacing * length_scale, extent / LEAST_CUBES)
    return merged(readings, edge, options.independent)


def merged(readings: TrainingSet, edge: float, independent: int) -> TrainingSet:
    """Return the readings averaged over cubes of an edge in metres, cut at its multiples.

    Merging what is merged already changes nothing, so that readings can be added later.

    Parameters
    ----------
    readings
        Readings as they were taken, or averages of earlier ones.
    edge
        Edge of the cubes that readings are merged in, metres.
    independent
        The most that the readings of one cube are worth.
    """
    means = group_means(readings, cubes_of(readings.points, edge))
    # Weighted means are what all readings of a cube are worth together where the field is linear
    # in it; beyond ``independent`` they share errors that no average removes.
    return replace(means, weight=np.minimum(means.weight, independent))


def group_means(readings: TrainingSet, owner: IntArray) -> TrainingSet:
    """Return the mean of each group of N readings, (N,), worth as much as these together."""
    worth = np.bincount(owner, readings.weight)
    columns = (np.hstack([readings.points, readings.field]) * readings.weight[:, None]).T
    means = np.column_stack([np.bincount(owner, column) for column in columns]) / worth[:, None]
    return TrainingSet(means[:, :3], means[:, 3:], np.asarray(worth))


def cubes_of(points: FloatArray, edge: float) -> IntArray:
    """Return the number of the cube of an edge in metres that each point, (N, 3), is in, (N,)."""
    cubes = np.floor(points / edge)
    _, owner = np.unique(cubes.astype(np.int64), axis=0, return_inverse=True)
    return np.asarray(owner)


def joined(first: TrainingSet, second: TrainingSet) -> TrainingSet:
    """Return the readings of both."""
    return TrainingSet(
        np.concatenate([first.points, second.points]),
        np.concatenate([first.field, second.field]),
        np.concatenate([first.weight, second.weight]),
    )


Errors = TypeVar("Errors", SuiteErrors, SurveyPoses)


def errors_together(before: Errors | None, after: Errors | None, first: int) -> Errors | None:
    """Return the errors of readings and of others, the first of which has this number then.

    Absent are those of what counts as exact.
    """
    if after is None:
        return before
    if before is None:
        return replace(after, reading=after.reading + first)
    return before.followed_by(after, first)


def survey_doubts(readings: TrainingSet) -> tuple[str, ...]:
    """Return what speaks against readings, a sentence each.

    Parameters
    ----------
    readings
        As they were taken, in the map frame.
    """
    return tuple(each for each in (disagreement(readings), strong(readings.field)) if each)


def narrow(points: FloatArray) -> str:
    """Return a sentence if all readings of a map lie on one line."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    if len(spread) > 1 and spread[1] > NARROW:
        return ""
    return (
        "the survey lies on one line: what the field does beside it is known from physics alone; "
        "drive more than one lane"
    )


def disagreement(readings: TrainingSet) -> str:
    """Return a sentence if readings of one place differ by more than a field can.

    Parameters
    ----------
    readings
        Of one sensor after the other, each in order of time.
    """
    cubes = np.floor(readings.points / SAME_PLACE).astype(np.int64)
    places, cube = np.unique(cubes, axis=0, return_inverse=True)
    differ = spans(readings.field, cube).max(axis=1)
    apart = np.linalg.norm(spans(readings.points, cube), axis=1)
    at = np.flatnonzero(differ > DISAGREE)
    centres = np.asarray((places[at] + 0.5) * SAME_PLACE, dtype=np.float64)
    steep = path_slopes(readings, centres)
    at = at[differ[at] > DISAGREE + STEEPER * steep * apart[at]]
    if not len(at):
        return ""
    worst = at[np.argmax(differ[at])]
    x, y, z = readings.points[cube == worst][0]
    return (
        f"readings of one place differ at {len(at)} of {len(differ)} places, by "
        f"{differ[worst]:.0f} uT at ({x:.1f}, {y:.1f}, {z:.1f}) m: check the suite's calibration, "
        f"clocks and poses"
    )


def spans(values: FloatArray, group: IntArray) -> FloatArray:
    """Return from where to where each group's values lie apart, shape (G, 3), of (N, 3)."""
    high = np.full((group.max() + 1, 3), -np.inf)
    low = -high
    np.maximum.at(high, group, values)
    np.minimum.at(low, group, values)
    return high - low


def path_slopes(readings: TrainingSet, places: FloatArray) -> FloatArray:
    """Return how much the field changes along the paths beside places, uT/m, shape (M,).

    From one reading of a sensor to its next: whether sensors agree does not matter. The median, so
    that no spike does, either.

    Parameters
    ----------
    readings
        Of one sensor after the other, each in order of time.
    places
        In the map frame in metres, shape (M, 3).
    """
    way = np.linalg.norm(np.diff(readings.points, axis=0), axis=1)
    rows = np.flatnonzero((way > 0.1 * SAME_PLACE) & (way < 2 * SAME_PLACE))
    if not len(rows) or not len(places):
        return np.zeros(len(places))
    rise = np.abs(np.diff(readings.field, axis=0)[rows]).max(axis=1) / way[rows]
    near = cKDTree(readings.points[rows]).query_ball_point(places, 2 * SAME_PLACE)
    return np.array([np.median(rise[own]) if own else 0.0 for own in near])


def strong(field: FloatArray) -> str:
    """Return a sentence if the field is stronger than that of the Earth and a building can be."""
    strength = np.linalg.norm(field, axis=1)
    share = float(np.mean(strength > STRONG))
    if share <= FEW:
        return ""
    return (
        f"{share:.0%} of the readings exceed {STRONG:g} uT, the strongest is {strength.max():.0f}: "
        "twice the Earth's field; check the unit, the suite's calibration, and for magnets"
    )

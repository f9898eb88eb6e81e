"""The naive peer: what a user would write in an afternoon.

scikit-learn's Gaussian process for each axis of the field, on a thinned survey around the drive,
and scipy's ``least_squares`` over t, C and H together, with numeric derivatives, on a part of the
readings. Thinning keeps it affordable: every query of the map costs the number of places
times the number of survey readings.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.errors import MapError, PeerError
from l2m_gtsam.maps.training import TrainingSet, checked_readings
from l2m_gtsam.options import Options
from l2m_gtsam.studies.methods import numeric_least_squares

FEWEST = 20


class NaiveOptions(Options):
    """How much of the data the naive peer can bear."""

    seed: int = Field(default=1, ge=0)
    """Of the choice of survey readings."""
    reach: float = Field(default=1.0, gt=0)
    """Survey readings within so many metres of the lidar's path enter: as far as a sensor, or a
    wrong start, may be from the lidar."""
    spacing: float = Field(default=0.45, gt=0)
    """Edge in metres of cubes of which each gives one reading, drawn at random."""
    places: int = Field(default=1500, ge=FEWEST)
    """The most readings that a Gaussian process is given, drawn at random from those."""
    learning: int = Field(default=500, ge=FEWEST)
    """The most of them from which its hyperparameters are learnt."""
    readings: int = Field(default=340, ge=5)
    """The most readings of a drive that are fitted, evenly spaced in time."""
    iterations: int = Field(default=50, ge=1)
    """The most steps of the least squares."""


@dataclass(frozen=True)
class NaiveMap:
    """Three Gaussian processes.

    Attributes
    ----------
    axes
        A fitted regressor of scikit-learn for each axis of the map frame.
    places
        How many survey readings each holds.
    """

    axes: tuple[Any, ...]
    places: int

    def field(self, points: FloatArray) -> FloatArray:
        """Return the field at points (N, 3) of the map frame in metres, shape (N, 3), uT."""
        return np.column_stack([axis.predict(points) for axis in self.axes])


def naive_map(
    points: FloatArray, field: FloatArray, path: FloatArray, options: NaiveOptions
) -> NaiveMap:
    """Return the map around a drive; other drives on its route are little farther from it.

    Parameters
    ----------
    points
        Places of the survey in the map frame in metres, shape (N, 3).
    field
        What was measured there, in the map frame in microtesla, shape (N, 3).
    path
        Positions of the lidar on the drive in the map frame in metres, shape (M, 3).
    options
        How much of the survey enters.

    Raises
    ------
    MapError
        A survey that is not finite, or too little of it near the drive.
    PeerError
        scikit-learn is not installed.
    """
    survey = checked_readings(points, field)
    near = survey[_near(survey, path, options)]
    learning = near[np.arange(min(len(near), options.learning))]
    axes = tuple(_process(learning, near, axis) for axis in range(3))
    return NaiveMap(axes, len(near))


def naive_peer(
    readings: Readings, field_map: NaiveMap, options: NaiveOptions, t_start: FloatArray
) -> FloatArray:
    """Return t, C row by row and H where the least squares end from C = I and H = 0, shape (15,).

    Parameters
    ----------
    readings
        Of one sensor.
    field_map
        Of the site.
    options
        How many readings enter, and how many steps are made.
    t_start
        The guess in the lidar frame in metres, shape (3,).
    """
    count = min(len(readings), options.readings)
    part = readings[np.linspace(0, len(readings) - 1, count).round().astype(np.int64)]
    found = numeric_least_squares(part, field_map.field, t_start[None], options.iterations)
    return np.asarray(found[0])


def _near(survey: TrainingSet, path: FloatArray, options: NaiveOptions) -> IntArray:
    """Return rows of a survey near a path in random order: one for each cube, not too many."""
    distance, _ = cKDTree(path).query(survey.points)
    rows = np.flatnonzero(distance <= options.reach)
    if len(rows) < FEWEST:
        raise MapError(
            f"naive peer: {len(rows)} of {len(survey)} survey readings lie within "
            f"{options.reach:g} m of the drive, {FEWEST} are needed: survey where it drives, or "
            "set a wider reach"
        )
    rows = np.random.default_rng(options.seed).permutation(rows)
    cubes = np.floor(survey.points[rows] / options.spacing).astype(np.int64)
    _, first = np.unique(cubes, axis=0, return_index=True)
    # In the order of the permutation, so that any beginning of them is a random choice.
    return np.asarray(rows[np.sort(first)][: options.places])


def _process(learning: TrainingSet, readings: TrainingSet, axis: int) -> Any:
    """Return a regressor for one axis: hyperparameters from some readings, fitted to all."""
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
    except ImportError as error:
        msg = "the naive peer needs scikit-learn: pip install 'l2m-gtsam[studies]'"
        raise PeerError(msg) from error
    kernel = ConstantKernel(1.0, (1e-3, 1e4)) * RBF(1.0, (0.1, 20.0)) + WhiteKernel(0.01)
    learner = GaussianProcessRegressor(kernel, normalize_y=True)
    with warnings.catch_warnings():
        # A hyperparameter at its bound is what a user would go on with.
        warnings.simplefilter("ignore", ConvergenceWarning)
        learner.fit(learning.points, learning.field[:, axis])
    fitted = GaussianProcessRegressor(learner.kernel_, optimizer=None, normalize_y=True)
    return fitted.fit(readings.points, readings.field[:, axis])

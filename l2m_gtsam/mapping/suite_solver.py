"""The sensors of a mapping suite by the marginal likelihood of their own drive.

The drive's poses are known, the field is not. With a wrong position or distortion a sensor measures
two fields at one place under two headings, and over the drive a field that no sources could make:
both are unlikely. The likelihood is maximised by Fisher scoring; strength and depth of the sources
are learnt again in each round. Where waves from below and above do not explain the readings, steel
beside the path is searched for with the sensors that were found, and the rounds go on with it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_likelihood import SIZE, C, SuiteLikelihood, suite_likelihood
from l2m_gtsam.mapping.suite_windows import SuiteWindows, sources_in, windows_over
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES, Sources
from l2m_gtsam.progress import Progress
from l2m_gtsam.solve.model_comparison import correlation_of

# A common factor of all fields cannot be separated from its inverse in all sensors: the mean of C's
# diagonals is held at its prior.
SAME_SCALE = 1e-5
DIAGONAL = [3, 7, 11]
SMALLEST = 1 / 16  # of a step
SETTLED = 0.5  # limit of a round's move of any parameter, in standard deviations
GAIN = 0.01  # of the log likelihood: a step that gains less is the last

ReadingsAt = Callable[[FloatArray], Readings]
"""From clock offsets in seconds, shape (S,), to the readings with the poses that they have then."""


@dataclass(frozen=True)
class SuiteRound:
    """The sensors of a suite after a round.

    Attributes
    ----------
    sensors
        (t, C row by row, H, time offset) in m, uT and s, shape (S, 16).
    windows
        Parts of the survey, with the prior of the field and the noise of a reading.
    left
        Of each window what the most likely field leaves of its readings, uT, shape (n, 3).
    covariance
        Of all parameters, shape (16 S, 16 S).
    settled
        Whether Fisher scoring converged.
    """

    sensors: FloatArray
    windows: SuiteWindows
    left: tuple[FloatArray, ...]
    covariance: FloatArray
    settled: bool

    def residuals(self) -> tuple[FloatArray, ...]:
        """Return what is left of each sensor's readings in its own axes, uT."""
        sensors = range(len(self.sensors))
        own: list[list[FloatArray]] = [[] for _ in sensors]
        for window, left in zip(self.windows.parts, self.left, strict=True):
            readings = window.readings
            b = -np.einsum("nji,nj->ni", readings.R_map_lidar, left)
            for i in sensors:
                rows = readings.rows_of(i)
                own[i].append(b[rows] @ self.sensors[i, C].reshape(3, 3).T)
        return tuple(np.concatenate(parts) for parts in own)

    def moved(self, before: FloatArray) -> float:
        """Return the largest move of a parameter in its sigmas."""
        away = np.abs(self.sensors - before).ravel()
        return float((away / np.sqrt(np.diag(self.covariance))).max())


@dataclass(frozen=True)
class SuiteSolution:
    """The last round.

    Attributes
    ----------
    last
        Sensors, windows and covariance.
    residuals
        Of each sensor ``C b + H - z`` in uT over the readings that were used, shape (n, 3).
    converged
        Whether the last round moved no parameter by more than ``SETTLED``.
    rounds
        Number of rounds.
    """

    last: SuiteRound
    residuals: tuple[FloatArray, ...]
    converged: bool
    rounds: int


def solve_suite(
    readings_at: ReadingsAt,
    assumed: FloatArray,
    options: SuiteCalibrationOptions,
    progress: Progress,
) -> SuiteSolution:
    """Estimate the sensors of a suite.

    Parameters
    ----------
    readings_at
        Readings of the survey for given clock offsets.
    assumed
        Prior means of the S sensors' parameters, shape (S, 16).
    options
        Prior sigmas, windows and limits.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    MapError
        There are too few readings.
    """
    problem = SuiteProblem(readings_at, assumed, options)
    sensors, sources, searches = assumed, NO_SOURCES, options.searches
    for round_ in range(options.rounds):
        progress("calibrating the suite", round_ / options.rounds)
        found = problem.solved(sensors, sources)
        sensors, settled = found.sensors, found.moved(sensors) < SETTLED
        # A field that is not explained may be why nothing settles.
        if searches and (settled or round_ + 1 == options.rounds // 2):
            steel = sources_in(found.windows, sensors, options)
            searches = searches - 1 if len(steel) else 0
            if len(steel):
                sources, settled = steel, False
        if settled:
            break
    progress("calibrating the suite", 1.0)
    return SuiteSolution(found, found.residuals(), settled and found.settled, round_ + 1)


@dataclass(frozen=True)
class SuiteStep:
    """The first scoring step from the assumed sensors.

    Attributes
    ----------
    names
        Of the S sensors.
    sigmas
        Change of (t, C row by row, H, time offset) in the sigmas of the scoring, shape (S, 16).
    explained
        Share of the residuals' squares that steps of the other windows take away in each.
    """

    names: tuple[str, ...]
    sigmas: FloatArray
    explained: float


def first_step(
    readings_at: ReadingsAt, assumed: FloatArray, options: SuiteCalibrationOptions
) -> SuiteStep:
    """Return the first step of ``solve_suite``, for the price of one evaluation.

    Raises
    ------
    MapError
        There are too few readings.
    """
    problem = SuiteProblem(readings_at, assumed, options)
    readings = readings_at(assumed[:, -1])
    return problem.step(
        windows_over(readings, assumed, NO_SOURCES, options), assumed, readings.sensors
    )


class SuiteProblem:
    """The likelihood of a drive and what is assumed of its sensors.

    Parameters
    ----------
    readings_at
        The drive.
    assumed
        Shape (S, 16).
    options
        How sure that is.
    """

    def __init__(
        self, readings_at: ReadingsAt, assumed: FloatArray, options: SuiteCalibrationOptions
    ) -> None:
        self._readings_at, self._assumed, self._options = readings_at, assumed, options
        self._information = prior_information(len(assumed), options)

    def solved(self, sensors: FloatArray, sources: Sources) -> SuiteRound:
        """Lay windows for these sensors and find those that make the readings most likely.

        Parameters
        ----------
        sensors
            To begin with, shape (S, 16).
        sources
            Of steel beside the path.
        """
        readings = self._readings_at(sensors[:, -1])
        windows = windows_over(readings, sensors, sources, self._options)
        score, settled = self._scored(windows, sensors), False
        for _ in range(self._options.steps):
            step = self._covariance(score, 1.0) @ score.slope
            better = self._along(windows, sensors, score, step)
            if better is None:
                settled = True
                break
            settled = better[1].value - score.value < GAIN
            sensors, score = better
            if settled:
                break
        alike = likeness(windows, score.residuals)
        return SuiteRound(
            sensors, windows, score.residuals, self._covariance(score, alike), settled
        )

    def step(self, windows: SuiteWindows, sensors: FloatArray, names: tuple[str, ...]) -> SuiteStep:
        """Return the scoring step of all windows, and how far steps of some explain the others.

        Sensors are the same in all windows; what the waves of one window leave out is not. So each
        window is asked what the step of the others gains in it, ``g^T d - d^T I d / 2``. Residuals
        are white by the noise of the windows' prior: twice that is the fall of their squares' sum.
        """
        scores = self._window_scores(windows, sensors)
        total = reduce(add, scores)
        covariance = self._covariance(total, 1.0)
        step = covariance @ total.slope
        fall = 0.0
        for own in scores:
            others = total.information - own.information + self._information
            d = cho_solve(cho_factor(others), total.slope - own.slope)
            fall += float(2 * own.slope @ d - d @ own.information @ d)
        count = sum(residual.size for residual in total.residuals)
        sigmas = (step / np.sqrt(np.diag(covariance))).reshape(sensors.shape)
        return SuiteStep(names, sigmas, fall / count)

    def _window_scores(self, windows: SuiteWindows, sensors: FloatArray) -> list[SuiteLikelihood]:
        """Return the likelihood of each window, without what is assumed."""
        readings = self._readings_at(sensors[:, -1])
        return [
            suite_likelihood(replace(part, readings=readings[rows]), sensors, windows.prior)
            for part, rows in zip(windows.parts, windows.rows, strict=True)
        ]

    def _covariance(self, score: SuiteLikelihood, alike: float) -> FloatArray:
        """Return the covariance where so many readings count as one, shape (16 S, 16 S)."""
        return np.asarray(np.linalg.inv(score.information / alike + self._information))

    def _along(
        self, windows: SuiteWindows, sensors: FloatArray, score: SuiteLikelihood, step: FloatArray
    ) -> tuple[FloatArray, SuiteLikelihood] | None:
        """Return sensors along a step that make the readings more likely, if there are any."""
        share = 1.0
        while share >= SMALLEST:
            trial = sensors + share * step.reshape(sensors.shape)
            new = self._scored(windows, trial)
            if new.value > score.value:
                return trial, new
            share /= 2
        return None

    def _scored(self, windows: SuiteWindows, sensors: FloatArray) -> SuiteLikelihood:
        """Return the posterior: slope and value with what is assumed, information without."""
        total = reduce(add, self._window_scores(windows, sensors))
        off = (sensors - self._assumed).ravel()
        pull = self._information @ off
        value = total.value - 0.5 * float(off @ pull)
        return replace(total, value=value, slope=total.slope - pull)


def likeness(windows: SuiteWindows, residuals: Sequence[FloatArray]) -> float:
    """Return how many readings count as one, from how residuals go together in time.

    Poses of a tracking system, the clock between two of its samples and waves that are left out err
    alike for a while.
    """
    parts, rows, first = [], [], 0
    for window, residual in zip(windows.parts, residuals, strict=True):
        sensor, stamp = window.readings.sensor, window.readings.stamp_ns
        for i in np.unique(sensor):
            own = np.flatnonzero(sensor == i)
            parts.append(residual[own[np.argsort(stamp[own], kind="stable")]])
            rows.append(slice(first, first + len(own)))
            first += len(own)
    return max(2 * float(correlation_of(np.concatenate(parts), rows).sum()) - 1, 1.0)


def prior_sigma(options: SuiteCalibrationOptions) -> FloatArray:
    """Return the standard deviations that are assumed of a sensor's parameters, shape (16,)."""
    sigmas = [options.position_m, options.matrix, options.offset_ut, options.clock_s]
    return np.repeat(sigmas, [3, 9, 3, 1])


def prior_information(count: int, options: SuiteCalibrationOptions) -> FloatArray:
    """Return the information about so many sensors that is assumed, shape (16 S, 16 S)."""
    sigma = prior_sigma(options)
    scale = np.zeros((count, SIZE))
    scale[:, DIAGONAL] = 1 / (count * len(DIAGONAL))
    fixed = np.outer(scale, scale) / SAME_SCALE**2
    return np.asarray(np.diag(np.tile(sigma**-2, count)) + fixed)

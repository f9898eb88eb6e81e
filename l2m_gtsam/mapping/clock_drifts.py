r"""Clocks of a survey's sensors that drift against that of the poses: found by the survey itself.

With a rate r a reading of stamp s is of the pose at s + tau + r u, u the time since the middle of
its drive. What r does to the readings is u times what the time offset does, and how likely it is
follows as for all parameters of a suite, with the field integrated out (``suite_likelihood``). A
sensor has one rate on all drives, as a crystal has.

A drift is taken out of the stamps. A map of stamps that drift is bent along the way: at 0.2 m/s by
10 mm for 50 ms, and in a turn of 1 rad/s the field is turned by three degrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from l2m_gtsam.data import FloatArray, IntArray, Readings, Recording
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_likelihood import late_slopes, suite_likelihood, window_slopes
from l2m_gtsam.mapping.suite_solver import likeness, prior_information
from l2m_gtsam.mapping.suite_windows import windows_over
from l2m_gtsam.maps.harmonic.structure import NO_SOURCES

# Of a rate: standard deviations below which it is none. Errors of a drive's poses and waves that
# are left out err alike for longer than neighbouring readings show.
LEAST_SIGMAS = 6.0
# Without any one window. A field that waves of one window do not follow looks like a drift there:
# in one of forty halls with exact clocks by 9 of them, and by none without that window.
LEAST_ELSEWHERE = 3.0
FASTEST = 0.01  # of a rate, prior: a clock that is off by more than a hundredth is none


@dataclass(frozen=True)
class ClockDrifts:
    """How fast clocks drift.

    Attributes
    ----------
    rates, sigmas
        Seconds per second of S sensors, shapes (S,).
    elsewhere
        How many standard deviations of each are left without the window that says most of it,
        shape (S,).
    """

    rates: FloatArray
    sigmas: FloatArray
    elsewhere: FloatArray

    @property
    def found(self) -> FloatArray:
        """Rates, zero where there is none, shape (S,)."""
        seen = np.abs(self.rates) > LEAST_SIGMAS * self.sigmas
        return np.where(seen & (self.elsewhere > LEAST_ELSEWHERE), self.rates, 0.0)


def clock_drifts(
    readings: Readings, drive: IntArray, sensors: FloatArray, options: SuiteCalibrationOptions
) -> ClockDrifts:
    """Return how fast the clocks of a survey's sensors drift, by one step of scoring.

    Parameters
    ----------
    readings
        Of the survey at the sensors' clocks, N in number.
    drive
        Which of K drives each is of, shape (N,).
    sensors
        Parameters of S sensors, shape (S, 16).
    options
        Windows, and how far sensors may be from these.

    Raises
    ------
    MapError
        There are too few readings.
    """
    windows = windows_over(readings, sensors, NO_SOURCES, options)
    seconds, known = since_middle(readings.stamp_ns, drive), sensors.size
    count = known + len(sensors)
    seen, residuals = [], []
    for part, rows in zip(windows.parts, windows.rows, strict=True):
        window = replace(part, readings=readings[rows])
        at = window_slopes(window, sensors, windows.prior)
        own = late_slopes(window, at, seconds[rows], len(sensors))
        slope = suite_likelihood(window, sensors, windows.prior).slope
        late = np.einsum("ni,nij->j", at.residual, own) / at.noise**2
        information = at.information(np.concatenate([at.slopes, own], axis=2))
        seen.append(ScoredWindow(information, np.append(slope, -late)))
        residuals.append(at.residual)
    alike = likeness(windows, residuals)
    prior = np.zeros((count, count))
    prior[:known, :known] = prior_information(len(sensors), options)
    prior[np.arange(known, count), np.arange(known, count)] = FASTEST**-2
    step, sigmas = scored(seen, alike, prior)
    # A survey of one window is judged by that.
    fewer = combinations(seen, len(seen) - 1) if len(seen) > 1 else [seen]
    without = [np.divide(*scored(each, alike, prior)) for each in fewer]
    elsewhere = (np.sign(step) * without).min(axis=0)
    return ClockDrifts(step[known:], sigmas[known:], elsewhere[known:])


@dataclass(frozen=True)
class ScoredWindow:
    """What a window says of p parameters: information, shape (p, p), and slope, shape (p,)."""

    information: FloatArray
    slope: FloatArray


def scored(
    windows: Sequence[ScoredWindow], alike: float, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return one step of scoring, shape (p,), and its standard deviations, shape (p,).

    Parameters
    ----------
    windows
        That take part.
    alike
        How many neighbouring readings err alike.
    prior
        Information about the parameters that is assumed, shape (p, p).
    """
    information = np.sum([each.information for each in windows], axis=0) / alike
    slope = np.sum([each.slope for each in windows], axis=0) / alike
    factor = cho_factor(information + prior)
    covariance = cho_solve(factor, np.eye(len(slope)))
    return cho_solve(factor, slope), np.sqrt(np.diag(covariance))


def since_middle(stamp_ns: IntArray, drive: IntArray) -> FloatArray:
    """Return seconds since the middle of each reading's drive, shape (N,)."""
    seconds = np.zeros(len(stamp_ns))
    for each in np.unique(drive):
        own = np.flatnonzero(drive == each)
        first, last = stamp_ns[own].min(), stamp_ns[own].max()
        seconds[own] = 1e-9 * (stamp_ns[own] - first) - 0.5e-9 * (last - first)
    return seconds


def steadied(recording: Recording, rates: dict[str, float]) -> Recording:
    """Return a recording whose sensors' stamps do not drift, by name; their middle stays."""
    series = []
    for each in recording.series:
        rate = rates.get(each.sensor, 0.0)
        if rate and len(each.stamp_ns):
            middle = each.stamp_ns[0] + (each.stamp_ns[-1] - each.stamp_ns[0]) // 2
            late = np.round(rate * (each.stamp_ns - middle)).astype(np.int64)
            each = replace(each, stamp_ns=each.stamp_ns + late)
        series.append(each)
    return replace(recording, series=tuple(series))

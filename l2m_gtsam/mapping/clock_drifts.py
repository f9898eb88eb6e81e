r"""Clocks of a survey's sensors that drift against that of the poses: found by the survey itself.

With a rate r a reading of stamp s is of the pose at s + tau + r u, u the time since the middle of
its drive. What r does to the readings is u times what the time offset does, and how likely it is
follows as for all parameters of a suite, with the field integrated out (``suite_likelihood``). A
sensor has one rate on all drives, as a crystal has.

A drift is taken out of the stamps. A map of stamps that drift is bent along the way: at 0.2 m/s by
10 mm for 50 ms, and in a turn of 1 rad/s the field is turned by three degrees.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Recording
from l2m_gtsam.mapping.seen_windows import SeenWindows, scored
from l2m_gtsam.mapping.suite_likelihood import SIZE, late_slopes

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


def clock_drifts(seen: SeenWindows, seconds: FloatArray) -> ClockDrifts:
    """Return how fast the clocks of a survey's S sensors drift, by one step of scoring.

    Parameters
    ----------
    seen
        The survey at the sensors' clocks.
    seconds
        Since the middle of the drive of each of its readings, shape (N,).
    """
    known = len(seen.prior)
    sensors = known // SIZE
    scores = [
        each.score(late_slopes(each.window, each.at, seconds[rows], sensors))
        for each, rows in zip(seen.each, seen.windows.rows, strict=True)
    ]
    alike = seen.likeness([each.at.residual for each in seen.each])
    prior = np.diag(np.full(known + sensors, FASTEST**-2))
    prior[:known, :known] = seen.prior
    step, sigmas = scored(scores, alike, prior)
    # A survey of one window is judged by that.
    fewer = combinations(scores, len(scores) - 1) if len(scores) > 1 else [scores]
    without = [np.divide(*scored(each, alike, prior)) for each in fewer]
    elsewhere = (np.sign(step) * without).min(axis=0)
    return ClockDrifts(step[known:], sigmas[known:], elsewhere[known:])


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

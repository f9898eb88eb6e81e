r"""H of a survey's sensors that jumps: found by the survey itself.

A load, a tool or a current that is switched changes H of a sensor from one moment on. A map of both
parts of the survey is neither's: what one place has under two offsets is averaged, or explained by
waves that are not there. What a jump does to the readings after it is what H does, and how likely
it is follows as for all parameters of a suite, with the field integrated out
(``suite_likelihood``): with the information I and the slope g of the change beside all parameters
of all sensors, it explains ``g^T I^{-1} g``.

Jumps are taken off the readings on one side, one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.errors import MapError
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.seen_windows import SeenWindow, SeenWindows, WindowScore
from l2m_gtsam.mapping.suite_likelihood import SIZE, H
from l2m_gtsam.mapping.survey_jump import SurveyJump
from l2m_gtsam.solve.chi_square import quantile

MOMENTS = 20  # at which a jump is tried at once
FEWEST = 20  # readings of the sensor in the windows before a jump, and after
ANYTHING_UT = 100.0  # standard deviation of a jump before the survey
# Twice a logarithm of likelihood. Of three numbers at some hundred moments chance gives 30 once in
# a thousand surveys; errors of poses and waves that are left out err alike for longer than
# neighbouring readings show.
LEAST_GAIN = 60.0
# Without any one window, of the same change: steel that came or went is in one place alone.
LEAST_ELSEWHERE = 15.0
# Of what windows, each by itself, may differ by: steel that came looks otherwise in each, and a
# drift is another change in places that are visited at other times.
ALIKE = 0.99
NEAR_M = 1.0  # from where the vehicle was when H jumped: there its moment is looked for closely
CLOSE = {"windows": 8, "readings": 3000}
SETTLED_S = 0.5  # between the readings that a jump lies between


@dataclass(frozen=True)
class TriedJump:
    """A jump of H of one or several sensors at one moment.

    Attributes
    ----------
    sensors
        The indices of k sensors, shape (k,).
    between
        Stamps of the last reading before it and of the first after.
    change
        H after less before in uT, shape (k, 3).
    gain
        Twice the logarithm by which the survey is more likely with it.
    right_after
        Whether H is as assumed after it, rather than before.
    """

    sensors: IntArray
    between: tuple[int, int]
    change: FloatArray
    gain: float
    right_after: bool

    def single(self, names: Sequence[str]) -> tuple[SurveyJump, ...]:
        """Return it for each sensor, by the names of all."""
        return tuple(
            SurveyJump(names[sensor], self.between[1], change, self.right_after)
            for sensor, change in zip(self.sensors.tolist(), self.change, strict=True)
        )


def jumps_of(
    readings: Readings, sensors: FloatArray, seen: SeenWindows, options: SuiteCalibrationOptions
) -> tuple[SurveyJump, ...]:
    """Return the jump of H that explains most of a survey, of one sensor or of several; or none.

    Parameters
    ----------
    readings
        Of the survey at the sensors' clocks.
    sensors
        Parameters of S sensors, shape (S, 16).
    seen
        Windows of these.
    options
        Of the windows.
    """
    every = np.arange(len(sensors))
    stamps = stamps_of(seen, every)[len(every) * FEWEST : -len(every) * FEWEST]
    moments = Moments.of(seen, every, stamps)
    found, most = None, 0.0
    for own in [*np.split(every, len(every)), *([every] if len(every) > 1 else [])]:
        tried = moments.best(own)
        net = 0.0 if tried is None else shown_gain(seen, tried) - LEAST_GAIN * len(own)
        if net > most:
            found, most = tried, net
    if found is None:
        return ()
    own = jumping(seen, found)
    found = closer_jump(seen, replace(found, sensors=own), stamps_of(seen, own)[FEWEST:-FEWEST])
    low, high = found.between
    if high - low > 1e9 * SETTLED_S:
        found = closely(readings, sensors, found, options)
    return found.single(readings.sensors)


def refined(
    found: Sequence[SurveyJump], seen: SeenWindows, names: Sequence[str]
) -> tuple[SurveyJump, ...]:
    """Return jumps that were taken off by what windows show to be left of them.

    Parameters
    ----------
    found
        J of them.
    seen
        The survey without them, by which the noise is that of readings alone.
    names
        Of its sensors.
    """
    if not found:
        return ()
    scores = []
    for each in seen.each:
        of = [(np.array([names.index(jump.sensor)]), np.array([jump.stamp_ns])) for jump in found]
        scores.append(each.score(np.concatenate([steps(each, *one) for one in of], axis=2)))
    left = explained(scores, seen.prior, 1.0).change
    return tuple(
        replace(jump, change=jump.change + more) for jump, more in zip(found, left, strict=True)
    )


def stamps_of(seen: SeenWindows, sensors: IntArray) -> IntArray:
    """Return the stamps of some sensors' readings in windows, ascending."""
    readings = [each.window.readings for each in seen.each]
    return np.unique(np.concatenate([e.stamp_ns[np.isin(e.sensor, sensors)] for e in readings]))


@dataclass(frozen=True)
class Moments:
    """What windows say of jumps of k sensors before a few of ascending stamps.

    Attributes
    ----------
    sensors
        Indices, shape (k,).
    stamps, few
        All stamps, and the numbers of M of them, not the first.
    scores
        Of each window: of all sensors of the suite, then of changes of the k at the M moments.
    prior
        Information about the suite that is assumed, shape (16 S, 16 S).
    """

    sensors: IntArray
    stamps: IntArray
    few: IntArray
    scores: tuple[WindowScore, ...]
    prior: FloatArray

    @classmethod
    def of(cls, seen: SeenWindows, sensors: IntArray, stamps: IntArray) -> "Moments":
        """Return what windows say."""
        few = some(len(stamps))
        scores = tuple(each.score(steps(each, sensors, stamps[few])) for each in seen.each)
        return cls(sensors, stamps, few, scores, seen.prior)

    def best(self, sensors: IntArray) -> TriedJump | None:
        """Return the jump of some of the sensors that explains most, if there is any moment.

        Readings count as erring independently.
        """
        known, size = len(self.prior), 3 * len(self.sensors)
        at = np.flatnonzero(np.isin(self.sensors, sensors))
        own = (3 * at[:, None] + np.arange(3)).ravel()
        tried = []
        for k, number in enumerate(self.few.tolist()):
            rows = np.append(np.arange(known), known + size * k + own)
            parts = [
                WindowScore(s.information[np.ix_(rows, rows)], s.slope[rows]) for s in self.scores
            ]
            found = explained(parts, self.prior, 1.0)
            between = int(self.stamps[number - 1]), int(self.stamps[number])
            after = is_right_after(parts, sensors)
            tried.append(TriedJump(sensors, between, found.change, found.gain, after))
        return max(tried, key=lambda each: each.gain, default=None)


def closer_jump(seen: SeenWindows, found: TriedJump, stamps: IntArray) -> TriedJump:
    """Return a jump that was tried at few of ascending stamps at the best of all."""
    while True:
        few = some(len(stamps))
        if not len(few):
            return found
        place = int(np.searchsorted(few, np.searchsorted(stamps, found.between[1])))
        first, last = few[max(place - 1, 0)], few[min(place + 1, len(few) - 1)]
        inner = stamps[first - 1 : last + 1]
        found = Moments.of(seen, found.sensors, inner).best(found.sensors) or found
        if len(some(len(inner))) == len(inner) - 1:
            return found
        stamps = inner


def some(count: int) -> IntArray:
    """Return a few of the numbers from 1 to below a count."""
    return np.unique(np.linspace(1, count - 1, max(min(count - 1, MOMENTS), 0)).astype(np.int64))


def steps(seen: SeenWindow, sensors: IntArray, moments: IntArray) -> FloatArray:
    """Return derivatives of N residuals by changes of H of k sensors at M moments.

    Shape (N, 3, 3 k M), the sensors of a moment together.
    """
    columns = SIZE * sensors[:, None] + np.arange(H.start, H.stop)
    own = seen.at.slopes[:, :, columns.ravel()]
    after = seen.window.readings.stamp_ns[:, None] >= moments
    return np.asarray((own[:, :, None, :] * after[:, None, :, None]).reshape(len(own), 3, -1))


@dataclass(frozen=True)
class ExplainedJump:
    """What changes of H of k sensors explain beside all parameters of all sensors.

    Attributes
    ----------
    gain
        Twice the logarithm of the likelihood ratio.
    sensors
        Step of the parameters of all S sensors beside them, shape (16 S,).
    change, covariance
        In uT, shapes (k, 3) and (3 k, 3 k).
    """

    gain: float
    sensors: FloatArray
    change: FloatArray
    covariance: FloatArray

    @property
    def gains(self) -> FloatArray:
        """What the change of each sensor explains beside the others, shape (k,)."""
        own = [
            self.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(self.change))
        ]
        return np.array(
            [c @ np.linalg.solve(each, c) for c, each in zip(self.change, own, strict=True)]
        )


def explained(scores: Sequence[WindowScore], prior: FloatArray, alike: float) -> ExplainedJump:
    """Return what changes explain.

    Parameters
    ----------
    scores
        Of windows: of the sensors, then of the changes.
    prior
        Information about the sensors that is assumed, shape (16 S, 16 S).
    alike
        How many readings count as one.
    """
    known = len(prior)
    information = np.sum([each.information for each in scores], axis=0) / alike
    information[:known, :known] += prior
    information[known:, known:] += np.eye(len(information) - known) * ANYTHING_UT**-2
    slope = np.sum([each.slope for each in scores], axis=0) / alike
    covariance = cho_solve(cho_factor(information), np.eye(len(slope)))
    alone = cho_solve(cho_factor(information[:known, :known]), slope[:known])
    left = slope[known:] - information[known:, :known] @ alone
    step, own = covariance @ slope, covariance[known:, known:]
    gain = float(left @ own @ left)
    return ExplainedJump(gain, step[:known], step[known:].reshape(-1, 3), own)


def is_right_after(scores: Sequence[WindowScore], sensors: IntArray) -> bool:
    """Return whether changes before the moment explain more than changes after it.

    Of sensors that are as assumed, so that H which the survey does not determine says nothing.
    """
    information = np.sum([each.information for each in scores], axis=0)
    slope = np.sum([each.slope for each in scores], axis=0)
    size = 3 * len(sensors)
    whole, after = np.zeros((2, size, len(slope)))
    columns = SIZE * sensors[:, None] + np.arange(H.start, H.stop)
    whole[np.arange(size), columns.ravel()] = 1.0
    after[:, -size:] = np.eye(size)
    gains = []
    for each in (after, whole - after):
        pull = each @ slope
        known = each @ information @ each.T + np.eye(size) * ANYTHING_UT**-2
        gains.append(float(pull @ cho_solve(cho_factor(known), pull)))
    return gains[1] > gains[0]


@dataclass(frozen=True)
class JudgedJump:
    """A jump as windows show it: their scores, and how many readings count as one beside it."""

    scores: tuple[WindowScore, ...]
    alike: float

    @classmethod
    def of(cls, seen: SeenWindows, tried: TriedJump) -> "JudgedJump":
        """Return a jump that was tried."""
        moment = np.array([tried.between[1]])
        columns = [steps(each, tried.sensors, moment) for each in seen.each]
        scores = [each.score(own) for each, own in zip(seen.each, columns, strict=True)]
        found = explained(scores, seen.prior, 1.0)
        # Sensors that are not as assumed leave residuals that are alike, and no jump explains.
        left = [
            each.at.residual
            + each.at.beside_field(each.at.slopes @ found.sensors + own @ found.change.ravel())
            for each, own in zip(seen.each, columns, strict=True)
        ]
        return cls(tuple(scores), seen.likeness(left))


def shown_gain(seen: SeenWindows, tried: TriedJump) -> float:
    """Return what a jump explains; nothing if it is not the same everywhere."""
    judged = JudgedJump.of(seen, tried)
    scores, alike = judged.scores, judged.alike
    fewer = combinations(scores, len(scores) - 1) if len(scores) > 1 else ()
    for each in fewer:
        found = explained(each, seen.prior, alike)
        if found.gain < LEAST_ELSEWHERE or np.sum(found.change * tried.change) <= 0:
            return 0.0
    single = [explained([each], seen.prior, alike) for each in scores]
    if differing(single) > quantile(ALIKE, tried.change.size * max(len(scores) - 1, 1)):
        return 0.0
    return explained(scores, seen.prior, alike).gain


def differing(found: Sequence[ExplainedJump]) -> float:
    """Return the sum of squares of what changes of windows differ by, in their sigmas."""
    changes = [each.change.ravel() for each in found]
    known = [cho_solve(cho_factor(e.covariance), np.eye(len(e.covariance))) for e in found]
    pull = np.sum([P @ c for P, c in zip(known, changes, strict=True)], axis=0)
    mean = np.linalg.solve(np.sum(known, axis=0), pull)
    return float(sum((c - mean) @ P @ (c - mean) for P, c in zip(known, changes, strict=True)))


def jumping(seen: SeenWindows, tried: TriedJump) -> IntArray:
    """Return which of the sensors of a jump explain anything by it."""
    judged = JudgedJump.of(seen, tried)
    gains = explained(judged.scores, seen.prior, judged.alike).gains
    return tried.sensors[gains >= min(LEAST_ELSEWHERE, float(gains.max()))]


def closely(
    readings: Readings, sensors: FloatArray, found: TriedJump, options: SuiteCalibrationOptions
) -> TriedJump:
    """Return a jump at its moment by all readings where the vehicle was then.

    Parameters
    ----------
    readings, sensors, options
        As of ``jumps_of``.
    found
        Between two readings that are seconds apart.
    """
    low, high = found.between
    then = (readings.stamp_ns >= low) & (readings.stamp_ns <= high)
    away, _ = cKDTree(readings.p_map_lidar[then]).query(readings.p_map_lidar)
    near, close = readings.select(np.asarray(away) < NEAR_M), options.model_copy(update=CLOSE)
    try:
        seen = SeenWindows.of(near, sensors, close)
    except MapError:  # too few readings there to look any closer
        return found
    stamps = stamps_of(seen, found.sensors)
    stamps = stamps[(stamps >= low) & (stamps <= high)]
    best = Moments.of(seen, found.sensors, stamps).best(found.sensors)
    if best is None:
        return found
    return replace(found, between=closer_jump(seen, best, stamps).between)

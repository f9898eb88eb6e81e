"""A jump of H of a sensor of a survey, and readings without it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray, Recording

SAME_S = 5.0  # from a jump that was taken off: what is found so near is left of it


@dataclass(frozen=True)
class SurveyJump:
    """A jump of H of one sensor of a survey.

    Attributes
    ----------
    sensor
        Its name.
    stamp_ns
        Of the first reading after it.
    change
        H after less before in uT, shape (3,).
    right_after
        Whether H is as assumed after it, rather than before.
    """

    sensor: str
    stamp_ns: int
    change: FloatArray
    right_after: bool

    def same(self, other: "SurveyJump") -> bool:
        """Return whether another is what was left of this one."""
        apart = abs(self.stamp_ns - other.stamp_ns)
        return self.sensor == other.sensor and apart < 1e9 * SAME_S

    def correction(self, stamp_ns: IntArray, moved_ns: int) -> FloatArray:
        """Return what is added to N readings of the sensor, uT, shape (N, 3).

        ``moved_ns`` was added to their stamps where the jump was found.
        """
        after, none = (stamp_ns + moved_ns >= self.stamp_ns)[:, None], np.zeros(3)
        if self.right_after:
            return np.where(after, none, self.change)
        return np.where(after, -self.change, none)


def with_more(found: Sequence[SurveyJump], more: Sequence[SurveyJump]) -> tuple[SurveyJump, ...]:
    """Return jumps that were taken off, and what was found beside them: more of these, or others.

    What is not explained yet counts as noise: the first estimate of a large jump is short of it.
    """
    every = list(found)
    for new in more:
        k = next((k for k, each in enumerate(every) if each.same(new)), None)
        if k is None:
            every.append(new)
        else:
            every[k] = replace(every[k], change=every[k].change + new.change)
    return tuple(every)


def without_jumps(recording: Recording, jumps: Sequence[SurveyJump], moved_ns: int) -> Recording:
    """Return a drive without jumps of H; ``moved_ns`` is as of ``SurveyJump.correction``."""
    if not jumps:
        return recording
    series = []
    for each in recording.series:
        own = [jump for jump in jumps if jump.sensor == each.sensor]
        if own:
            corrections = [jump.correction(each.stamp_ns, moved_ns) for jump in own]
            each = replace(each, field=each.field + np.sum(corrections, axis=0))
        series.append(each)
    return replace(recording, series=tuple(series))

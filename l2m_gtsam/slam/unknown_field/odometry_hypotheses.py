"""What a drive may be where odometry is in doubt, each followed by a filter of its own."""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.online.step_doubts import likely, shares
from l2m_gtsam.slam.relative_motion import from_end
from l2m_gtsam.slam.slips import SLIPPED
from l2m_gtsam.slam.unknown_field.field_filter import FieldFilter, FilterState, FilterStep


@dataclass(frozen=True)
class Hypothesis:
    """One way that a drive may be.

    Attributes
    ----------
    state
        At the last key pose.
    poses
        All key poses, in the frame of the field.
    recorded
        Numbers of the key poses to which the step was as recorded, of those in doubt.
    """

    state: FilterState
    poses: tuple[gtsam.Pose3, ...]
    recorded: frozenset[int]

    @property
    def log_odds(self) -> float:
        """Log likelihood, and what speaks for recorded steps before any reading."""
        return self.state.log_likelihood + SLIPPED * len(self.recorded)


@dataclass(frozen=True)
class Hypotheses:
    """All that are followed, the likeliest first.

    Attributes
    ----------
    all
        One at least.
    """

    all: tuple[Hypothesis, ...]

    @classmethod
    def begun(cls, follows: FieldFilter) -> "Hypotheses":
        """Return the one at the first key pose."""
        state = follows.start()
        return cls((Hypothesis(state, (state.pose,), frozenset()),))

    @property
    def best(self) -> Hypothesis:
        """The likeliest."""
        return self.all[0]

    def after(
        self, key_pose: ArrivedKeyPose, follows: FieldFilter, was_motion: bool | None
    ) -> "Hypotheses":
        """Return what they are at the next key pose.

        Parameters
        ----------
        key_pose
            The next.
        follows
            The filter.
        was_motion
            Of its step, where there is a recorded one beside it: what was decided before, None if
            nothing.
        """
        steps = []  # with those in doubt that are motion by them
        if key_pose.recorded is None or not was_motion:
            steps.append((step_of(key_pose), frozenset[int]()))
        if key_pose.recorded is not None and was_motion is not False:
            steps.append((step_of(key_pose.recorded), frozenset({key_pose.number})))
        found = []
        for each in self.all:
            for step, own in steps:
                state = follows.after(each.state, step)
                recorded = each.recorded | own
                found.append(Hypothesis(state, (*each.poses, state.pose), recorded))
        return Hypotheses(tuple(likely(found)))

    def pose_covariance(self) -> FloatArray:
        """Return the covariance of the likeliest pose, with what speaks for others, (6, 6)."""
        total = np.zeros((6, 6))
        for weight, each in zip(shares(self.all), self.all, strict=True):
            apart = gtsam.Pose3.Logmap(self.best.state.pose.between(each.state.pose))
            total += weight * (each.state.pose_covariance + np.outer(apart, apart))
        return total


def step_of(key_pose: ArrivedKeyPose) -> FilterStep:
    """Return the step to a key pose with its readings."""
    readings = key_pose.readings
    if len(readings):
        readings = from_end(readings, key_pose.R, key_pose.p)
    return FilterStep(key_pose.step, key_pose.covariance, readings, key_pose.drift, key_pose.fixed)

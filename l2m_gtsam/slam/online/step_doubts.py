"""Steps of odometry that are in doubt: what a drive may be, until the readings decide.

A step far from the motion before it is a slip, or motion that odometry caught up with. A step over
a gap of odometry is right, or odometry has lost the motion in it. Fields between both ends say
nothing about either, so that each is followed apart, and the likelihood of the readings decides.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from l2m_gtsam.data import FloatArray

MOST = 4  # hypotheses: of two steps that nothing has decided yet
CERTAIN = 7.0  # nats, a thousand to one


class Possible(Protocol):
    """One way that a drive may be."""

    @property
    def recorded(self) -> frozenset[int]:
        """Numbers of the key poses to which the step was as recorded, of those in doubt."""

    @property
    def log_odds(self) -> float:
        """Log likelihood, and what speaks for recorded steps before any reading."""


P = TypeVar("P", bound=Possible)


@dataclass(frozen=True)
class StepDecision:
    """What a step of odometry in doubt was.

    Attributes
    ----------
    number
        Of the key pose at its end.
    was_motion
        Whether the vehicle moved as odometry recorded.
    """

    number: int
    was_motion: bool


def ranked(found: Sequence[P]) -> list[P]:
    """Return the likeliest hypotheses, as many as are followed, the likeliest first."""
    return sorted(found, key=lambda each: -each.log_odds)[:MOST]


def likely(found: Sequence[P]) -> list[P]:
    """Return the hypotheses that are worth following, the likeliest first."""
    first = ranked(found)
    return [each for each in first if each.log_odds >= first[0].log_odds - CERTAIN]


def shares(found: Sequence[Possible]) -> FloatArray:
    """Return the probability of each hypothesis, shape (N,)."""
    odds = np.array([each.log_odds for each in found])
    share = np.exp(odds - odds.max())
    return np.asarray(share / share.sum())


def decided(found: Sequence[Possible], numbers: Sequence[int]) -> tuple[StepDecision, ...]:
    """Return those of some steps in which all hypotheses agree."""
    decisions = []
    for number in numbers:
        said = {number in each.recorded for each in found}
        if len(said) == 1:
            decisions.append(StepDecision(number, said.pop()))
    return tuple(decisions)

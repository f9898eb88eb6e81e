"""A drive in a map that is followed both ways over a gap of odometry, until the readings decide.

The step over a gap is right, with no more than odometry's stated error, or as uncertain as it
differs from the motion before. With the latter alone readings would draw a pose that odometry knows
to another place of a like field, metres away.

Over metres the map is not linear, and what the first readings say is not to be relied on: nothing
is decided before there are some (``decisions``), and until then the covariance holds the prior odds
that the step is wrong.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.online.belief import POSE, Belief
from l2m_gtsam.slam.online.follower import Follower
from l2m_gtsam.slam.online.key_pose import WRONG, ArrivedKeyPose
from l2m_gtsam.slam.online.step_doubts import decided, likely, ranked
from l2m_gtsam.slam.slips import SLIPPED

LONGEST = 200  # key poses, after which what nothing has decided stays as it is likelier


@dataclass(frozen=True)
class GapDoubt:
    """A step over a gap of odometry, of which it is not known whether it is right.

    Attributes
    ----------
    stamp_ns
        Time of its end.
    covariance
        Of a right perturbation of it if it is not, shape (6, 6).
    """

    stamp_ns: int
    covariance: FloatArray

    @property
    def off_m(self) -> float:
        """Standard deviation of its position if it is not right, along the least axis, metres."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:, 3:])[0]))


@dataclass(frozen=True)
class Branch:
    """One way that a drive may be.

    Attributes
    ----------
    follower
        That follows it.
    recorded
        Numbers of the key poses to which the step was as recorded, of those in doubt.
    """

    follower: Follower
    recorded: frozenset[int] = frozenset()

    @property
    def log_odds(self) -> float:
        """Log likelihood, and what speaks for recorded steps before any reading."""
        return self.follower.log_likelihood + SLIPPED * len(self.recorded)

    def after(self, key_pose: ArrivedKeyPose) -> list["Branch"]:
        """Add the next key pose, and return what becomes of this branch: both ways over a gap."""
        found = [self]
        if key_pose.is_over_gap:
            other = self.follower.forked()
            other.add(key_pose.as_recorded)
            found.append(Branch(other, self.recorded | {key_pose.number}))
        self.follower.add(key_pose)
        return found


class BranchedFollower:
    """Localises a drive on line in a map, with all that it may be over gaps of odometry.

    Parameters
    ----------
    branches
        One at least, the likeliest first.
    doubts
        Those that nothing has decided yet, by the numbers of the key poses after gaps.
    """

    def __init__(self, *branches: Branch, doubts: Mapping[int, GapDoubt] | None = None) -> None:
        self.branches, self.doubts = branches, dict(doubts or {})

    @property
    def best(self) -> Follower:
        """The likeliest."""
        return self.branches[0].follower

    @property
    def belief(self) -> Belief:
        """The likeliest posterior of the last key pose, with the doubts that are left."""
        belief = self.best.belief
        if not self.doubts:
            return belief
        covariance = belief.covariance.copy()
        for each in self.doubts.values():
            covariance[:POSE, :POSE] += WRONG * each.covariance
        return replace(belief, covariance=covariance)

    def add(self, key_pose: ArrivedKeyPose) -> Belief:
        """Add the next key pose, and return its posterior.

        Raises
        ------
        CalibrationError
            The system is too badly scaled to be solved.
        """
        found = [after for each in self.branches for after in each.after(key_pose)]
        for each in found:
            each.follower.release()
        first = ranked(found)
        old = {number for number in self.doubts if key_pose.number - number >= LONGEST}
        said = first[0].recorded & old
        self.branches = tuple(each for each in first if each.recorded & old == said)
        if key_pose.is_over_gap:
            self.doubts[key_pose.number] = GapDoubt(key_pose.stamp_ns, key_pose.covariance)
        return self.belief

    def decisions(self) -> list[tuple[GapDoubt, bool]]:
        """Leave what is not likely any more; return which steps over gaps were right by that."""
        self.branches = tuple(likely(self.branches))
        found = decided(self.branches, list(self.doubts))
        numbers = {each.number for each in found}
        self.branches = tuple(
            replace(each, recorded=each.recorded - numbers) for each in self.branches
        )
        return [(self.doubts.pop(each.number), each.was_motion) for each in found]

    def finish(self) -> Belief:
        """Solve for the key poses that the filters alone have had so far."""
        for each in self.branches:
            each.follower.finish()
        return self.belief

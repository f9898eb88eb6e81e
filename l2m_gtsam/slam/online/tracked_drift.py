"""Odometry's steady drift, as it comes to be known where a map tells a vehicle's place.

Over some metres a drift of a share of the distance is lost in the noise of a few readings, and over
the whole drive it is what odometry is off by. So it is found from the way since an anchor, the key
pose from which on it is counted: what odometry says of it less what the map says is the drift, but
for odometry's other errors and for those of both ends. These sums are all that is kept of a drive.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import eigh

from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.online.belief import Belief
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose

# Share of the drift's variance over a way, below which errors of its ends are what the map leaves.
# Places that follow odometry err with the drift itself, as much as it is not known.
OBSERVED = 0.1
BETTER = 0.25  # times the variance of the anchor: another one is worth beginning anew


@dataclass(frozen=True)
class DriftPrior:
    """A steady drift along the axes of the map, in the standard deviations of key poses.

    Attributes
    ----------
    drift
        Mean, shape (3,).
    covariance
        Shape (3, 3).
    """

    drift: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class WaySinceAnchor:
    """What odometry says of the way since a key pose, along the axes of the map.

    Attributes
    ----------
    p, covariance
        Where that key pose is in the map, shape (3,), metres, and the covariance, shape (3, 3).
    shift
        By odometry, shape (3,), metres.
    random
        Covariance of odometry's other errors over it, shape (3, 3).
    drift_m
        What one standard deviation of the drift along each axis adds, shape (3,).
    """

    p: FloatArray
    covariance: FloatArray
    shift: FloatArray
    random: FloatArray
    drift_m: FloatArray = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def begun(cls, belief: Belief) -> "WaySinceAnchor":
        """Return the way from a key pose, of no length yet."""
        return cls(*place_of(belief), np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True)
class TrackedDrift:
    """A steady drift and the way by which it is found.

    Attributes
    ----------
    before
        What was known of it at the anchor.
    known
        What is known of it now.
    way
        Since the anchor.
    over_m
        The least distance over which it counts as a random walk of the same variance, metres.
    unobserved_m
        Path since the map last determined the place along all axes.
    """

    before: DriftPrior
    known: DriftPrior
    way: WaySinceAnchor
    over_m: float
    unobserved_m: float = 0.0

    @classmethod
    def at_start(cls, over_m: float, belief: Belief) -> "TrackedDrift":
        """Return a drift of which nothing is known but its standard deviation, at a first key pose.

        Parameters
        ----------
        over_m
            As of the class.
        belief
            Of the first key pose.
        """
        unknown = DriftPrior(np.zeros(3), np.eye(3))
        return cls(unknown, unknown, WaySinceAnchor.begun(belief), over_m)

    def without(self, key_pose: ArrivedKeyPose, before: Belief) -> ArrivedKeyPose:
        """Return a key pose whose step has only what is not known of the drift.

        Parameters
        ----------
        key_pose
            By odometry.
        before
            Of the key pose before.
        """
        drift_m, turn = drift_of(key_pose), np.linalg.norm(key_pose.turning)
        if not drift_m.any() and not turn:
            return key_pose
        R = before.pose.rotation().matrix()
        to_end = (R @ key_pose.R).T
        up = to_end[:, 2]
        # What is not known is the same all along: as a walk it has that variance after this way.
        over = max(self.over_m, self.unobserved_m) / key_pose.length_m
        covariance = key_pose.covariance.copy()
        left = drift_m[:, None] * self.known.covariance * drift_m
        covariance[3:, 3:] += over * (to_end @ left @ to_end.T)
        # Readings in a map tell the heading all along: it drifts between them alone.
        covariance[:3, :3] += self.over_m * key_pose.length_m * turn**2 * np.outer(up, up)
        p = key_pose.p - R.T @ (drift_m * self.known.drift)
        none = np.zeros(3)
        return replace(key_pose, p=p, covariance=covariance, steady=none, turning=none)

    def moved(self, key_pose: ArrivedKeyPose, before: Belief) -> "TrackedDrift":
        """Return it after a step by odometry, arguments as of ``without``."""
        R, way = before.pose.rotation().matrix(), self.way
        of_end = R @ key_pose.R
        random = of_end @ key_pose.covariance[3:, 3:] @ of_end.T
        longer = replace(
            way,
            shift=way.shift + R @ key_pose.p,
            random=way.random + random,
            drift_m=way.drift_m + drift_of(key_pose),
        )
        return replace(self, way=longer, unobserved_m=self.unobserved_m + key_pose.length_m)

    def seen(self, belief: Belief) -> "TrackedDrift":
        """Return it with what the place of the last key pose says, which readings determine."""
        p, covariance = place_of(belief)
        found = self._by_place(p, covariance)
        if np.trace(covariance) < BETTER * np.trace(self.way.covariance):
            return found.anchored(belief)
        return found

    def anchored(self, belief: Belief) -> "TrackedDrift":
        """Return the same counted from a key pose on, as after a motion that odometry lost."""
        return replace(self, before=self.known, way=WaySinceAnchor.begun(belief))

    def _by_place(self, p: FloatArray, covariance: FloatArray) -> "TrackedDrift":
        """Return it with the place of the last key pose, with its covariance, m."""
        way, before = self.way, self.before
        axes = np.flatnonzero(way.drift_m)
        if not len(axes):
            return self
        own, w = np.ix_(axes, axes), way.drift_m[axes]
        ends = (covariance + way.covariance)[own]
        prior = w[:, None] * before.covariance[own] * w
        # Along these directions both are diagonal: which of them are the map's?
        share, directions = eigh(ends, prior)
        along = directions[:, share < OBSERVED]
        off = (way.shift - (p - way.p) - way.drift_m * before.drift)[axes]
        S = along.T @ (prior + ends + way.random[own]) @ along
        crossed = before.covariance[:, axes] * w @ along
        gain = np.linalg.solve(S, crossed.T).T
        known = DriftPrior(
            before.drift + gain @ (along.T @ off), before.covariance - gain @ crossed.T
        )
        unobserved_m = 0.0 if len(axes) == along.shape[1] else self.unobserved_m
        return replace(self, known=known, unobserved_m=unobserved_m)


def drift_of(key_pose: ArrivedKeyPose) -> FloatArray:
    """Return what one standard deviation of the drift along each axis adds to a step, m, (3,)."""
    return key_pose.steady * key_pose.length_m


def place_of(belief: Belief) -> tuple[FloatArray, FloatArray]:
    """Return where a key pose is in the map in metres, shape (3,), and the covariance, (3, 3)."""
    R = belief.pose.rotation().matrix()
    return belief.pose.translation(), R @ belief.pose_covariance[3:, 3:] @ R.T

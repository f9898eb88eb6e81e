r"""Errors of the lidar's poses that last: variables ``P(k)`` at knots of the drive.

A pose is wrong by ``true = measured Exp(L u)``, with L a root of its covariance and u six
independent Ornstein-Uhlenbeck processes of unit variance. At a sensor this changes the field by

.. math::
    F u, \quad F = \left( [b]_\times - S [t]_\times \;\; S \right) L, \quad S = R^T G R

Between two knots u is what they say plus a bridge, which is independent of all other bridges and
whose covariance is exact here: the knots may be far apart.

Knots much further apart than errors last say next to nothing of what sensors share between them.
Then the variables are the means of u over the segments, which are as good as independent.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from l2m_factors import PoseMotion, moved, skew
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.view import QueryableMap, places_of
from l2m_gtsam.data import FloatArray, IntArray, Readings

SEGMENTS = 60  # of a drive, at most: six weights at each end of one
ROUNDING = 1e-9  # of a segment: a drive of just so many has no more for it
SHORTEST_S = 1e-6  # stands for errors that do not last
SHORT = 0.25  # of a segment: means over segments say more of errors that last no longer


@dataclass(frozen=True)
class PoseKnots:
    """Where pose errors are variables.

    Attributes
    ----------
    seconds
        Times, drive by drive, shape (K,); each drive has two at least, evenly spread over it.
    correlation_s
        Time over which the correlation falls to 1/e. Errors of two drives have nothing in common.
    spacing
        Time between each knot and the next in seconds, infinite from one drive to the next, shape
        (K - 1,).
    of_each_pose
        Whether errors are mostly each pose's own: variables say next to nothing of single ones.
    """

    seconds: FloatArray
    correlation_s: float
    spacing: FloatArray
    of_each_pose: ClassVar[bool] = False

    @staticmethod
    def over(
        seconds: FloatArray, correlation_s: float, drive: IntArray | None = None
    ) -> "PoseKnots":
        """Return knots for times, shape (N,): two for as long as an error lasts, if not fewer.

        ``drive`` says which drive each time is of, shape (N,); absent if all are of one.
        """
        of = np.zeros(len(seconds), dtype=np.int64) if drive is None else drive
        drives = [seconds[of == each] for each in np.unique(of)]
        ends = [(own.min(), max(own.max(), own.min() + SHORTEST_S)) for own in drives]
        whole = float(sum(last - first for first, last in ends))
        between = max(correlation_s / 2, whole / SEGMENTS)
        knots, spacing = [], []
        for first, last in ends:
            count = max(int(np.ceil((last - first) / between - ROUNDING)) + 1, 2)
            knots.append(np.linspace(first, last, count))
            spacing += [float(knots[-1][1] - knots[-1][0])] * (count - 1) + [np.inf]
        spaced = np.array(spacing[:-1])
        short = correlation_s < SHORT * float(np.median(spaced[np.isfinite(spaced)]))
        kind = SegmentMeans if short else PoseKnots
        return kind(np.concatenate(knots), max(correlation_s, SHORTEST_S), spaced)

    @property
    def correlation(self) -> FloatArray:
        """Of the errors at each knot and the next, shape (K - 1,)."""
        return self._like(self.spacing)

    def segment(self, seconds: FloatArray) -> IntArray:
        """Return the knot before each time, shape (N,)."""
        before = np.searchsorted(self.seconds, seconds, side="right") - 1
        before = np.clip(before, 0, len(self.seconds) - 2)
        # At the very end of a drive the knot before is not the drive's last.
        return np.asarray(before - np.isinf(self.spacing[before]))

    def weights(self, seconds: FloatArray) -> FloatArray:
        """Return what the knots before and after say of the error at each time, shape (N, 2)."""
        return self._weights(*self._between(seconds))

    def at_knots(self, seconds: FloatArray) -> FloatArray:
        """Return the correlation of each time with the knots before and after, shape (N, 2)."""
        after, spacing = self._between(seconds)
        return np.column_stack([self._like(after), self._like(spacing - after)])

    def left(self, seconds: FloatArray, weights: FloatArray, at_knots: FloatArray) -> FloatArray:
        """Return the covariance of what the knots leave open at times of one segment, (n, n).

        Parameters
        ----------
        seconds
            The times, shape (n,).
        weights, at_knots
            What the methods of these names say of them, shapes (n, 2).
        """
        return np.asarray(self._like(np.abs(seconds[:, None] - seconds)) - weights @ at_knots.T)

    def _between(self, seconds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the time since the knot before and that from it to the next, shapes (N,)."""
        segment = self.segment(seconds)
        spacing = self.spacing[segment]
        return np.clip(seconds - self.seconds[segment], 0.0, spacing), spacing

    def _weights(self, after: FloatArray, spacing: FloatArray) -> FloatArray:
        # An Ornstein-Uhlenbeck process is Markov: between two knots it depends on these alone.
        # With q = exp(-gap / tau) the weights are [q_a, q_b] times the inverse of [[1, q], [q, 1]];
        # expm1 keeps the digits of 1 - q^2 where knots are close.
        whole = -np.expm1(-2 * spacing / self.correlation_s)
        return np.column_stack(
            [
                (self._like(gap) - self._like(2 * spacing - gap)) / whole
                for gap in (after, spacing - after)
            ]
        )

    def _like(self, apart: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-apart / self.correlation_s))


@dataclass(frozen=True)
class SegmentMeans(PoseKnots):
    """Means of short errors over the segments between knots, each at the knot before, as variables.

    What one mean has in common with the next is next to nothing; within a segment the covariance is
    exact.
    """

    of_each_pose = True

    @property
    def correlation(self) -> FloatArray:
        """Of one mean and the next, shape (K - 1,): none."""
        return np.zeros(len(self.spacing))

    def at_knots(self, seconds: FloatArray) -> FloatArray:
        """Return the correlation of each time with its mean, and none with the next, (N, 2)."""
        return self._weights(*self._between(seconds))

    def _weights(self, after: FloatArray, spacing: FloatArray) -> FloatArray:
        # Integrals of exp(-|tau| / T): over the segment from a time in it, and over both times.
        T = self.correlation_s
        whole = 2 * T * (spacing + T * np.expm1(-spacing / T))
        own = -T * (np.expm1(-after / T) + np.expm1(-(spacing - after) / T))
        return np.column_stack([own / np.sqrt(whole), np.zeros(len(after))])


def error_of_poses(readings: Readings, field_map: QueryableMap, estimate: Estimate) -> FloatArray:
    """Return F of readings at an estimate, uT in the lidar frame, shape (N, 3, 6).

    It is zero where poses are taken as exact.
    """
    if readings.pose_root is None:
        return np.zeros((len(readings), 3, 6))
    R, t = readings.R_map_lidar, estimate.t[readings.sensor]
    field, gradient = field_map.field_and_gradient(places_of(readings, estimate.t))
    R_lidar_map = R.transpose(0, 2, 1)
    b_lidar = np.einsum("nij,nj->ni", R_lidar_map, field)
    return pose_features(readings.pose_root, b_lidar, R_lidar_map @ gradient @ R, t)


def pose_features(
    pose_root: FloatArray, b_lidar: FloatArray, slope: FloatArray, t: FloatArray
) -> FloatArray:
    """Return F: what a pose error does to the field at a sensor, uT in the lidar frame, (N, 3, 6).

    Parameters
    ----------
    pose_root
        L in rad and m, shape (N, 6, 6).
    b_lidar
        Field in the lidar frame in uT, shape (N, 3).
    slope
        ``R^T G R`` in uT/m, shape (N, 3, 3).
    t
        Position of the sensor in the lidar frame in metres, shape (N, 3).
    """
    # b = R^T B(R t + p) under a right perturbation of the pose; see ``key_pose_residuals``.
    turn = skew(b_lidar) - slope @ skew(t)
    return np.asarray(np.concatenate([turn, slope], axis=2) @ pose_root)


def at_likely_poses(
    readings: Readings,
    pose_root: FloatArray,
    errors: FloatArray,
    features: FloatArray,
    C: FloatArray,
) -> Readings:
    """Return readings where poses are corrected by their likely errors u, which keep their prior.

    A pose's own error is no variable of the graph but part of a reading's noise. What multiplies
    the field has to be taken where the readings put the pose all the same, or it comes out too
    small: errors in variables (Fuller, Measurement Error Models, 1987). The field takes up
    ``C F u``, so that residuals stay those at the measured poses to first order.

    Parameters
    ----------
    readings
        N, with poses as they were measured.
    pose_root
        L in rad and m, shape (N, 6, 6).
    errors
        u, without a unit, shape (N, 6).
    features
        F, as of ``error_of_poses``, shape (N, 3, 6).
    C
        Distortion matrix of the sensor of each, shape (N, 3, 3).
    """
    twist = np.einsum("nij,nj->ni", pose_root, errors)
    rest = PoseMotion(twist, np.zeros(len(readings)))
    R, p = moved(readings.R_map_lidar, readings.p_map_lidar, rest, np.ones(len(readings)))
    read = np.einsum("nij,nj->ni", C @ features, errors)
    return replace(readings, R_map_lidar=R, p_map_lidar=p, field=readings.field + read)


def pose_seconds(readings: Readings) -> FloatArray:
    """Return when the readings' poses were taken, seconds after the first stamp, shape (N,)."""
    seconds = 1e-9 * (readings.stamp_ns - readings.stamp_ns.min(initial=np.iinfo(np.int64).max))
    offset = 0.0 if readings.motion is None else readings.motion.offset
    return np.asarray(seconds + offset)

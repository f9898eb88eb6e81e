"""Stretches of a drive where the map no longer holds, or where odometry slipped.

Steel that was moved adds a field that grows slowly as the vehicle comes near. Poses follow it, as
far as odometry allows, and no single reading is an outlier. Many readings in a row that leave more
than noise reveal it. No reading near such a stretch is used then, and odometry bridges it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.ndimage import uniform_filter1d

from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.pose_graph import step_errors
from l2m_gtsam.solve.chi_square import exceeded_by

AXES = 3
ROUNDS = 5  # limit of removing changed stretches and solving again
WINDOW = 9  # key poses that are tested together
CHANCE = 1e-6  # false alarms of the test per drive
MOST_REJECTED = 0.5  # of every sensor's readings in a window
# A dipole's field falls with the third power of the distance: a quarter of what is detected acts
# 1.6 times as far, from a source at this distance from the path.
FURTHER, BESIDE_M = 1.6, 1.0
LEAST_LEFT = 0.5  # share of the readings; with fewer it is another place, not a changed one
SLIP_CHANCE = 1e-4  # false alarms per drive of an odometry that is as good as it states
FREEDOM = 6
MAX_REPORTED = 3  # the largest slips; the others are counted


def runs(marked: BoolArray) -> list[tuple[int, int]]:
    """Return the first and the past-the-end row of each run of marked rows."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]])))
    return [(int(first), int(last)) for first, last in ends.reshape(-1, 2)]


@dataclass(frozen=True)
class ReadingFits:
    """Residuals of N readings of a drive of K key poses.

    Attributes
    ----------
    key_pose, sensor
        Numbers of each one's key pose and sensor, shape (N,).
    inside
        Whether the map has data there, shape (N,).
    used
        Whether it counts, shape (N,).
    squared
        Squared length of its whitened residual, shape (N,).
    p
        Positions of the key poses in metres, shape (K, 3).
    """

    key_pose: IntArray
    sensor: IntArray
    inside: BoolArray
    used: BoolArray
    squared: FloatArray
    p: FloatArray

    def per_key_pose(self, values: FloatArray) -> FloatArray:
        """Return sums of values of readings, shape (N,), in windows about key poses, (K,)."""
        sums = np.bincount(self.key_pose, weights=values, minlength=len(self.p))
        return np.asarray(uniform_filter1d(sums, WINDOW, mode="constant") * WINDOW)


def changed(fit: ReadingFits) -> BoolArray:
    """Return which key poses are in or near stretches whose readings do not fit, shape (K,)."""
    wrong = _misfitting(fit) | _rejected(fit)
    about = np.zeros_like(wrong)
    for first, last in runs(wrong):
        about[_reach(fit.p, first, last)] = True
    return about


def _misfitting(fit: ReadingFits) -> BoolArray:
    """Return where readings that count leave more than noise, by a chi-square test, shape (K,)."""
    freedom = AXES * np.round(fit.per_key_pose(fit.used.astype(np.float64)))
    left = fit.per_key_pose(np.where(fit.used, fit.squared, 0.0))
    there = freedom > 0
    # Where all of a map is slightly wrong, a window is compared with the others.
    scale = max(1.0, float(np.median(left[there] / freedom[there]))) if there.any() else 1.0
    return there & (left > scale * exceeded_by(CHANCE / len(fit.p), np.maximum(freedom, 1)))


def _rejected(fit: ReadingFits) -> BoolArray:
    """Return where most readings of every sensor were rejected, shape (K,)."""
    least, some = np.ones(len(fit.p), dtype=np.bool_), np.zeros(len(fit.p), dtype=np.bool_)
    for sensor in np.unique(fit.sensor):
        own = fit.sensor == sensor
        read = np.round(fit.per_key_pose((own & fit.inside).astype(np.float64)))
        counted = np.round(fit.per_key_pose((own & fit.inside & fit.used).astype(np.float64)))
        least &= counted <= (1 - MOST_REJECTED) * read
        some |= read > 0
    return least & some


def _reach(p: FloatArray, first: int, last: int) -> slice:
    """Return the key poses before and after a stretch that are within reach of the change."""
    middle = p[first:last].mean(axis=0)
    away = np.linalg.norm(p - middle, axis=1)
    radius = FURTHER * np.hypot(away[first:last].max(), BESIDE_M)
    beyond = away > radius
    before, after = np.flatnonzero(beyond[:first]), np.flatnonzero(beyond[last:])
    start = int(before[-1]) + 1 if len(before) else 0
    end = last + int(after[0]) if len(after) else len(p)
    return slice(start, end)


@dataclass(frozen=True)
class Slip:
    """Consecutive steps at which poses and odometry differ.

    Attributes
    ----------
    start_s, end_s
        Its time since the first key pose.
    distance_m, angle_deg
        Difference between the poses' motion and odometry's.
    times
        Its ratio to the standard deviation that odometry states.
    """

    start_s: float
    end_s: float
    distance_m: float
    angle_deg: float
    times: float

    def __str__(self) -> str:
        return (
            f"from {self.start_s:.1f} to {self.end_s:.1f} s the poses differ from odometry by "
            f"{self.distance_m:.2f} m and {self.angle_deg:.1f} deg, {self.times:.1f} times its "
            "standard deviation: it slipped there, or a clock was set"
        )


def slip_notes(drive: Drive, poses: list[gtsam.Pose3], scale_error: float = 0.0) -> tuple[str, ...]:
    """Return a sentence on each of the largest slips, and how many more there are.

    Parameters
    ----------
    drive
        K key poses with odometry.
    poses
        Their estimates.
    scale_error
        Relative error of odometry's lengths.
    """
    found = sorted(slips(drive, poses, scale_error), key=lambda each: -each.times)
    largest = sorted(found[:MAX_REPORTED], key=lambda each: each.start_s)
    more = [f"odometry slipped in {len(found) - MAX_REPORTED} more stretches"]
    return (*map(str, largest), *(more if len(found) > MAX_REPORTED else []))


def slips(drive: Drive, poses: list[gtsam.Pose3], scale_error: float = 0.0) -> Iterator[Slip]:
    """Yield where poses and odometry differ, in order of time; arguments as above."""
    if not len(drive.steps):
        return
    errors = step_errors(drive, poses, scale_error)
    squared = np.einsum(
        "ni,ni->n", errors, np.linalg.solve(drive.steps.covariance, errors[:, :, None])[:, :, 0]
    )
    apart = squared > exceeded_by(SLIP_CHANCE / len(squared), FREEDOM)
    seconds = 1e-9 * (drive.stamp_ns - drive.stamp_ns[0])
    for first, last in runs(apart):
        moved = errors[first:last].sum(axis=0)
        yield Slip(
            start_s=float(seconds[first]),
            end_s=float(seconds[last]),
            distance_m=float(np.linalg.norm(moved[3:])),
            angle_deg=float(np.rad2deg(np.linalg.norm(moved[:3]))),
            times=float(np.sqrt(squared[first:last].max() / FREEDOM)),
        )

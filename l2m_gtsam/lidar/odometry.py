"""Odometry from scans: KISS-ICP follows the lidar, generalised ICP on key scans refines it.

KISS-ICP matches points to points of its own map. That is robust, but in rooms it drifts by about
1 % of the distance, and all directions count as determined. So each scan is registered once more,
on the last key scan, from KISS-ICP's pose; that gives the pose and its covariance.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, RigidTransform, Trajectory
from l2m_gtsam.geometry import (
    IDENTITY,
    as_matrix,
    between,
    compose,
    difference,
    from_matrix,
    moved,
    perturbed,
)
from l2m_gtsam.lidar.registration import (
    PoseEstimate,
    RegistrationOptions,
    by_scan,
    register,
    unseen_covariance,
)
from l2m_gtsam.lidar.surface import Surface, library
from l2m_gtsam.options import Options
from l2m_gtsam.records.scans import Scan, taken_at_once

FRAME, CHILD_FRAME = "odom", "lidar"
# Scans with fewer points are empty or broken.
LEAST_POINTS = 100


class KissOdometry:
    """Follows a lidar by KISS-ICP.

    Parameters
    ----------
    voxel_m
        Cells of its map in metres.
    range_m
        It forgets what is further away, metres.
    """

    def __init__(self, voxel_m: float, range_m: float) -> None:
        config = library("kiss_icp.config").KISSConfig()
        config.data.deskew = False  # scans come as if they had been taken at once
        config.data.min_range, config.data.max_range = 0.0, range_m
        config.mapping.voxel_size = voxel_m
        config.registration.max_num_threads = 1  # sums in one order: the same scans, the same poses
        self._kiss: Any = library("kiss_icp.kiss_icp").KissICP(config)

    def follow(self, points: FloatArray, expected: RigidTransform) -> RigidTransform:
        """Return the step to a scan from the one before.

        Parameters
        ----------
        points
            Of the scan in the lidar frame in metres, shape (N, 3).
        expected
            The step as it is expected; KISS-ICP's own guess takes scans for evenly spaced.
        """
        self._kiss.last_delta = as_matrix(expected)
        self._kiss.register_frame(points, np.zeros(0))
        return from_matrix(np.asarray(self._kiss.last_delta))


class ScanOdometryOptions(Options):
    """How a lidar is followed from scan to scan."""

    voxel_m: float = Field(default=0.5, ge=0.05)
    """Cells of KISS-ICP's map in metres."""
    map_range_m: float = Field(default=60.0, gt=0)
    """KISS-ICP forgets what is further away than this, metres."""
    key_distance_m: float = Field(default=1.0, gt=0)
    """A scan becomes the key scan after this distance,"""
    key_angle_deg: float = Field(default=20.0, gt=0, le=180)
    """or this rotation."""
    registration: RegistrationOptions = RegistrationOptions(
        least_share=0.6, unseen_m=1.0, unseen_deg=5.0
    )
    """How scans are registered on key scans. `unseen_m` and `unseen_deg` are those of one step."""


@dataclass(frozen=True)
class ScanStep:
    """A scan and where odometry has it.

    Attributes
    ----------
    stamp_ns
        Time of the scan in nanoseconds.
    T_odom_lidar
        Pose in the frame of the first scan.
    step
        The lidar in its frame at the scan before; the identity for the first.
    covariance
        Of a right perturbation of the step, rotation (rad) before translation (m), shape (6, 6):
        both its ends are wrong.
    surface
        What the scan saw, in the lidar frame at its stamp, thinned.
    believed
        Whether the scan was registered, not only predicted.
    """

    stamp_ns: int
    T_odom_lidar: RigidTransform
    step: RigidTransform
    covariance: FloatArray
    surface: Surface
    believed: bool


def follow(scans: Iterable[Scan], options: ScanOdometryOptions) -> Iterator[ScanStep]:
    """Yield the scans that have points enough, each with its pose.

    Parameters
    ----------
    scans
        In order of time.
    options
        How they are followed.

    Raises
    ------
    LidarError
        The extra `lidar` is not installed.
    """
    waiting = (scan for scan in scans if len(scan) >= LEAST_POINTS)
    first, second = next(waiting, None), next(waiting, None)
    if first is None:
        return
    follower = _Follower(first, _first_twist(first, second, options), options)
    yield follower.first
    for scan in waiting if second is None else chain([second], waiting):
        yield follower.add(scan)


def odometry(scans: Iterable[Scan], options: ScanOdometryOptions) -> Trajectory:
    """Return the poses that ``follow`` gives, with covariances that accumulate.

    The frame is that of the first scan. Errors of steps count as independent. Those of scans on one
    key scan undo each other, so that sigmas of poses far apart are rather too large.
    """
    return accumulated(follow(scans, options))


def accumulated(steps: Iterable[ScanStep]) -> Trajectory:
    """Return the poses of steps; the covariance of each is that of the motion from the first."""
    stamps, poses, covariances = [], list[RigidTransform](), list[FloatArray]()
    for each in steps:
        stamps.append(each.stamp_ns)
        poses.append(each.T_odom_lidar)
        before = covariances[-1] if covariances else np.zeros((6, 6))
        covariances.append(moved(before[None], each.step)[0] + each.covariance)
    return Trajectory(
        np.array(stamps, dtype=np.int64),
        np.reshape([each.R for each in poses], (-1, 3, 3)),
        np.reshape([each.t for each in poses], (-1, 3)),
        FRAME,
        CHILD_FRAME,
        np.reshape(covariances, (-1, 6, 6)),
    )


@dataclass(frozen=True)
class _Placed:
    """A scan that others are registered on, and the covariance of its pose on the key scan."""

    surface: Surface
    T: RigidTransform
    covariance: FloatArray


class _Follower:
    """The state between two scans."""

    def __init__(self, scan: Scan, twist: FloatArray, options: ScanOdometryOptions) -> None:
        points = taken_at_once(scan, twist)
        surface, exact = Surface(points, options.registration.edge), np.zeros((6, 6))
        self.first = ScanStep(scan.stamp_ns, IDENTITY, IDENTITY, exact, surface, True)
        self.twist = twist
        self._options = options
        self._kiss = KissOdometry(options.voxel_m, options.map_range_m)
        self._kiss.follow(points, IDENTITY)
        self._key = self._last = _Placed(surface, IDENTITY, exact)
        self._stamp_ns = scan.stamp_ns

    def add(self, scan: Scan) -> ScanStep:
        """Return where a scan is that has points enough."""
        seconds = 1e-9 * (scan.stamp_ns - self._stamp_ns)
        points = taken_at_once(scan, self.twist)
        surface = Surface(points, self._options.registration.edge)
        predicted = self._kiss.follow(points, perturbed(IDENTITY, seconds * self.twist))
        placed = self._registered(surface, compose(self._last.T, predicted))
        if placed is None:  # after a pause the lidar may have stood still meanwhile
            placed = self._registered(surface, self._last.T)
        estimate = self._unknown(predicted, seconds) if placed is None else placed
        step = between(self._last.T, estimate.T)
        covariance = moved(self._last.covariance[None], step)[0] + estimate.covariance
        believed = placed is not None
        self._advance(_Placed(surface, estimate.T, estimate.covariance), believed)
        self._stamp_ns, self.twist = scan.stamp_ns, difference(IDENTITY, step) / seconds
        return ScanStep(scan.stamp_ns, estimate.T, step, covariance, surface, believed)

    def _registered(self, surface: Surface, guess: RigidTransform) -> PoseEstimate | None:
        """Return the pose by the key scan or, where that is out of sight, by the scan before."""
        options = self._options.registration
        for base in (self._key, self._last):
            guess_base = between(base.T, guess)
            found = register(surface, base.surface, guess_base, options)
            if found.refusal(options) is None:
                estimate = by_scan(found, guess_base, options)
                return PoseEstimate(compose(base.T, estimate.T), estimate.covariance)
        return None

    def _unknown(self, predicted: RigidTransform, seconds: float) -> PoseEstimate:
        """Return what is left without a registration: the prediction, and little trust in it.

        The motion that is predicted may as well have ended when the last scan was taken.
        """
        covariance = unseen_covariance(self._options.registration) * max(1.0, seconds) ** 2
        motion = difference(IDENTITY, predicted)
        covariance = covariance + np.outer(motion, motion)
        return PoseEstimate(compose(self._last.T, predicted), covariance)

    def _advance(self, placed: _Placed, believed: bool) -> None:
        error = difference(self._key.T, placed.T)
        far = np.linalg.norm(error[3:]) >= self._options.key_distance_m
        turned = np.linalg.norm(error[:3]) >= np.deg2rad(self._options.key_angle_deg)
        self._last = placed
        if far or turned or not believed:
            self._key = self._last = replace(placed, covariance=np.zeros((6, 6)))


def _first_twist(first: Scan, second: Scan | None, options: ScanOdometryOptions) -> FloatArray:
    """Return how the lidar moves at first, shape (6,): motion distorts both scans alike."""
    if second is None or first.time_s is None:
        return np.zeros(6)
    trial = _Follower(first, np.zeros(6), options)
    trial.add(second)
    return trial.twist

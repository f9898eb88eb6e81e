"""Scans on those of earlier visits, as they come: loops of key poses where there is no map."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.geometry import between, compose, difference, moved
from l2m_gtsam.lidar.loop_closures import KeyScan, LoopOptions, candidates, closed_loop
from l2m_gtsam.lidar.odometry import LEAST_POINTS
from l2m_gtsam.lidar.registration import PoseEstimate, Refusal
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.slam.links import Links, carried_on, seen_from_before
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, ScanAtKeyPose
from l2m_gtsam.slam.online.scan_matcher import ScanLinks
from l2m_gtsam.slam.options import DriftOptions

CONTRADICTS = "a loop of scans is left out: it contradicts odometry and readings"
POSE = 6


@dataclass(frozen=True)
class KeptScan:
    """A scan of an earlier visit.

    Attributes
    ----------
    key_pose
        Number of its key pose.
    T_key_scan
        The lidar at the scan, by odometry in the frame of the key pose.
    stamp_ns, points, path_m
        As of ``KeyScan``.
    """

    key_pose: int
    T_key_scan: RigidTransform
    stamp_ns: int
    points: "np.ndarray[tuple[int, ...], np.dtype[np.float32]]"
    path_m: float

    @cached_property
    def surface(self) -> Surface:
        """What it saw; scans of later visits are compared with it again and again."""
        return Surface(self.points.astype(np.float64))

    def seen_from(self, T_map_key: RigidTransform) -> KeyScan:
        """Return it as it is placed by its key pose."""
        T = compose(T_map_key, self.T_key_scan)
        return KeyScan(self.stamp_ns, self.points, T, self.path_m)


class LoopMatcher:
    """Registers scans on those of earlier visits to their places.

    One is kept per place, so that memory grows with the building and not with the drive.

    Parameters
    ----------
    options
        Which scans are kept and compared, and which loops are believed.
    edge
        Cell size in metres; scans are thinned to one point per cell.
    drift
        Of odometry, from a scan to its key pose.
    largest
        Squared distance of a loop from where it is expected, in sigmas, that passes for noise.
    """

    def __init__(
        self, options: LoopOptions, edge: float, drift: DriftOptions, largest: float
    ) -> None:
        self._options, self._edge, self._drift, self._largest = options, edge, drift, largest
        self.kept: list[KeptScan] = []
        self.path_m, self.last_m = 0.0, -np.inf  # so far, and at the last scan that was compared

    def loops(
        self,
        key_pose: ArrivedKeyPose,
        expected: PoseEstimate,
        known: Callable[[int], PoseEstimate],
    ) -> ScanLinks:
        """Return the loops that a key pose closes, and keep a scan of a new place.

        Parameters
        ----------
        key_pose
            With its scans.
        expected
            Where it is expected.
        known
            Returns where an earlier key pose is known to have been.
        """
        self.path_m += key_pose.length_m
        found, refused = [Links.none()], list[str]()
        for each in key_pose.scans:
            if self.path_m - self.last_m < self._options.key_distance_m:
                continue
            if len(each.points) < LEAST_POINTS:
                refused.append("a scan has too few points")
                continue
            self.last_m = self.path_m
            for closed in self._compared(key_pose, each, expected, known):
                if isinstance(closed, str):
                    refused.append(closed)
                else:
                    found.append(closed)
        return ScanLinks(Links.joined(found), tuple(refused))

    def resume(self, kept: Sequence[KeptScan], path_m: float, last_m: float) -> None:
        """Go on with what was kept before."""
        self.kept, self.path_m, self.last_m = list(kept), path_m, last_m

    def _compared(
        self,
        key_pose: ArrivedKeyPose,
        at: ScanAtKeyPose,
        expected: PoseEstimate,
        known: Callable[[int], PoseEstimate],
    ) -> list[Links | str]:
        """Return loops of a scan, or why they are left out."""
        surface, options = Surface(at.points, self._edge), self._options
        T = compose(expected.T, at.T_key_scan)
        here = KeyScan.of(key_pose.stamp_ns, surface, T, self.path_m)
        before = [known(each.key_pose) for each in self.kept]
        scans = [each.seen_from(there.T) for each, there in zip(self.kept, before, strict=True)]
        found = list[Links | str]()
        for row in candidates(scans, here, options):
            first = self.kept[row].surface
            closed = closed_loop(scans[row], here, first, surface, options.registration)
            if isinstance(closed, Refusal):
                continue  # of single scans most see too little of each other
            earlier = self.kept[row]
            seen = PoseEstimate(closed.T_from_to, closed.covariance)
            seen = carried_on(seen, at.T_key_scan.inverse(), self._drift)
            seen = seen_from_before(seen, earlier.T_key_scan, self._drift)
            if self._fits(seen, before[row], expected):
                found.append(Links.single(earlier.key_pose, key_pose.number, seen))
            else:
                found.append(CONTRADICTS)
        is_new = all(np.linalg.norm(each.T.t - T.t) >= options.key_distance_m for each in scans)
        if is_new and CONTRADICTS not in found:  # true scans would contradict one that lies
            own = here.stamp_ns, here.points, here.path_m
            self.kept.append(KeptScan(key_pose.number, at.T_key_scan, *own))
        return found

    def _fits(self, seen: PoseEstimate, before: PoseEstimate, expected: PoseEstimate) -> bool:
        """Return whether a loop is where both poses' estimates expect it.

        These count as independent, which makes the gate wider than it could be.
        """
        T = between(before.T, expected.T)
        covariance = moved(before.covariance[None], T)[0] + expected.covariance + seen.covariance
        off = difference(T, seen.T)
        return bool(off @ np.linalg.solve(covariance, off) <= self._largest)

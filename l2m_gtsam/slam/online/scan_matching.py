"""Scans as they come: on the cloud of a map, or on those of earlier visits where there is no map.

On a map they fix the key poses of their times; without one they close loops. A registration takes
as long as all else at a key pose, and a scan has up to four with earlier ones: these are spread
over the key poses that come meanwhile.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_gtsam.data import RigidTransform, joined_rows
from l2m_gtsam.geometry import between, compose, difference, moved
from l2m_gtsam.lidar.loop_closures import KeyScan, LoopOptions, candidates, closing_loop
from l2m_gtsam.lidar.odometry import LEAST_POINTS
from l2m_gtsam.lidar.registration import PoseEstimate, Refusal, by_scan, register
from l2m_gtsam.lidar.scan_localisation import ScanLocalisationOptions
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.slam.links import MAP, Links, carried_on, seen_from_before
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose, ScanAtKeyPose
from l2m_gtsam.slam.options import DriftOptions

CONTRADICTS = "a loop of scans is left out: it contradicts odometry and readings"
PIECE_M = 0.05  # of path, in which a surface is made or two scans are registered one way


@dataclass(frozen=True)
class ScanLinks:
    """What scans say of a key pose, and why some say nothing."""

    links: Links
    refused: tuple[str, ...]


class ScanMatcher:
    """Registers scans on a cloud.

    Parameters
    ----------
    cloud
        In the map frame.
    options
        How, and when a scan is refused.
    drift
        Of odometry, from the scan to its key pose.
    """

    def __init__(
        self, cloud: Surface, options: ScanLocalisationOptions, drift: DriftOptions
    ) -> None:
        self._cloud, self._drift = cloud, drift
        self._options = options.beside_odometry()
        self._path_m = np.inf  # since the last fix

    def fixes(
        self, scans: Sequence[ScanAtKeyPose], number: int, expected: PoseEstimate, step_m: float
    ) -> ScanLinks:
        """Return what scans say of a key pose.

        Parameters
        ----------
        scans
            At the key pose.
        number
            Of the key pose.
        expected
            Where it is expected in the map.
        step_m
            Path in metres since the key pose before.
        """
        self._path_m += step_m
        found, refused = [Links.none()], list[str]()
        for each in scans:
            if len(each.points) < LEAST_POINTS:
                refused.append("a scan has too few points")
                continue
            guess = compose(expected.T, each.T_key_scan)
            registration = self._options.registration
            surface = Surface(each.points, registration.edge)
            seen = register(surface, self._cloud, guess, registration)
            if (refusal := seen.refusal(registration)) is not None:
                refused.append(f"a scan is left out: {refusal.value}")
                continue
            found.append(self._link(by_scan(seen, guess, registration), each, number))
            self._path_m = 0.0
        return ScanLinks(joined_rows(found), tuple(refused))

    def _link(self, fix: PoseEstimate, at: ScanAtKeyPose, number: int) -> Links:
        """Return a fix of a scan as one of its key pose, less what neighbouring ones share."""
        # n fixes that share an error of the cloud get n times its covariance.
        over = self._options.cloud_over_m
        shared = over / np.clip(self._path_m, 0.02 * over, over)
        own = PoseEstimate(fix.T, fix.covariance + shared * self._options.of_cloud())
        return Links.single(MAP, number, carried_on(own, at.T_key_scan.inverse(), self._drift))


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


@dataclass
class ScanBehind:
    """A scan that is compared, as seen from the newest key pose.

    Attributes
    ----------
    key_pose
        Number of that key pose.
    expected
        Where it is expected.
    T_key_scan
        The lidar at the scan in its frame, by odometry.
    """

    key_pose: int
    expected: PoseEstimate
    T_key_scan: RigidTransform

    def go_on(self, key_pose: ArrivedKeyPose, expected: PoseEstimate) -> None:
        """See it from the next key pose."""
        step = RigidTransform(key_pose.R, key_pose.p)
        self.key_pose, self.expected = key_pose.number, expected
        self.T_key_scan = between(step, self.T_key_scan)


class LoopMatcher:
    """Registers scans on those of earlier visits to their places.

    One is kept per place, so that memory grows with the building and not with the drive.

    Parameters
    ----------
    options
        Which scans are kept and compared, and which loops are believed.
    drift
        Of odometry, from a scan to its key pose.
    largest
        Squared distance of a loop from where it is expected, in sigmas, that passes for noise.
    """

    def __init__(self, options: LoopOptions, drift: DriftOptions, largest: float) -> None:
        self._options, self._drift, self._largest = options, drift, largest
        self.kept: list[KeptScan] = []
        self.path_m, self.last_m = 0.0, -np.inf  # so far, and at the last scan that was compared
        self._behind: ScanBehind | None = None
        self._work: Iterator[Links | str | None] = iter(())  # what is left of comparing it

    def loops(
        self, key_pose: ArrivedKeyPose, expected: PoseEstimate, known: Callable[[int], PoseEstimate]
    ) -> ScanLinks:
        """Return the loops of a key pose that are found by now, and keep a scan of a new place.

        A scan may be that of a key pose before: odometry carries on what it says.

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
        if self._behind is not None:
            self._behind.go_on(key_pose, expected)
        found = list[Links | str | None]()
        for each in key_pose.scans:
            if self.path_m - self.last_m < self._options.key_distance_m:
                continue
            if len(each.points) < LEAST_POINTS:
                found.append("a scan has too few points")
                continue
            self.last_m = self.path_m
            found += self._work  # all that is left of the scan before
            self._behind = ScanBehind(key_pose.number, expected, each.T_key_scan)
            self._work = self._comparing(self._behind, key_pose.stamp_ns, each, known)
        found += self._advanced(max(round(key_pose.length_m / PIECE_M), 1))
        links = [each for each in found if isinstance(each, Links)]
        refused = tuple(each for each in found if isinstance(each, str))
        return ScanLinks(joined_rows([Links.none(), *links]), refused)

    def resume(self, kept: Sequence[KeptScan], path_m: float, last_m: float) -> None:
        """Go on with what was kept before; a scan that was being compared is left out."""
        self.kept, self.path_m, self.last_m = list(kept), path_m, last_m
        self._behind, self._work = None, iter(())

    def _advanced(self, pieces: int) -> list[Links | str]:
        """Do so many pieces of the work, and return what they found."""
        found = list[Links | str]()
        for outcome in self._work:
            if outcome is not None:
                found.append(outcome)
                continue
            pieces -= 1
            if not pieces:
                break
        return found

    def _comparing(
        self,
        behind: ScanBehind,
        stamp_ns: int,
        at: ScanAtKeyPose,
        known: Callable[[int], PoseEstimate],
    ) -> Iterator[Links | str | None]:
        """Yield loops of a scan, or why they are left out; None after other pieces of the work."""
        own, options = behind.key_pose, self._options
        T = compose(behind.expected.T, at.T_key_scan)
        surface = Surface(at.points, options.registration.edge)
        here = KeyScan.of(stamp_ns, surface, T, self.path_m)
        scans = [each.seen_from(known(each.key_pose).T) for each in self.kept]
        contradicts = False
        for row in candidates(scans, here, options):
            yield None
            earlier = self.kept[row]
            closed = yield from closing_loop(
                scans[row], here, earlier.surface, surface, options.registration
            )
            if isinstance(closed, Refusal):
                continue  # of single scans most see too little of each other
            seen = PoseEstimate(closed.T_from_to, closed.covariance)
            seen = carried_on(seen, behind.T_key_scan.inverse(), self._drift)
            seen = seen_from_before(seen, earlier.T_key_scan, self._drift)
            if self._fits(seen, known(earlier.key_pose), behind.expected):
                yield Links.single(earlier.key_pose, behind.key_pose, seen)
            else:
                contradicts = True
                yield CONTRADICTS
        is_new = all(np.linalg.norm(each.T.t - T.t) >= options.key_distance_m for each in scans)
        if is_new and not contradicts:  # true scans would contradict one that lies
            self.kept.append(KeptScan(own, at.T_key_scan, stamp_ns, here.points, here.path_m))

    def _fits(self, seen: PoseEstimate, before: PoseEstimate, expected: PoseEstimate) -> bool:
        """Return whether a loop is where both poses' estimates expect it.

        These count as independent, which makes the gate wider than it could be.
        """
        T = between(before.T, expected.T)
        covariance = moved(before.covariance[None], T)[0] + expected.covariance + seen.covariance
        off = difference(T, seen.T)
        return bool(off @ np.linalg.solve(covariance, off) <= self._largest)

"""Loop closures: scans of revisited places, registered on those of earlier visits."""

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.geometry import between
from l2m_gtsam.lidar.odometry import ScanStep
from l2m_gtsam.lidar.registration import Refusal, RegistrationOptions, by_scan, register
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.options import Options
from l2m_gtsam.progress import completed
from l2m_gtsam.records.scans import LoopClosure


class LoopOptions(Options):
    """Where loop closures are searched for, and which are believed."""

    key_distance_m: float = Field(default=1.0, gt=0)
    """A key scan is kept after each such distance; loops are closed between key scans."""
    search_m: float = Field(default=3.0, gt=0)
    """Key scans are compared that are nearer than this by odometry, metres,"""
    least_way_m: float = Field(default=10.0, gt=0)
    """and between which the path is at least this long, metres."""
    most: int = Field(default=2, ge=1)
    """The most earlier places that a scan is compared with, the nearest first."""
    registration: RegistrationOptions = RegistrationOptions(
        reach_m=2.0, least_share=0.6, least_directions=6
    )
    """How scans are registered. Single scans see less of each other than of a cloud. A loop has to
    be believed both ways, and to determine all six directions: one part of a corridor looks like
    another."""


@dataclass(frozen=True)
class KeyScan:
    """A scan as it is kept.

    Attributes
    ----------
    stamp_ns
        Its time in nanoseconds.
    points
        Thinned, in metres in the lidar frame, shape (N, 3), in half the memory.
    T
        Pose of the lidar, by odometry or as it is known by now.
    path_m
        Path to it in metres.
    """

    stamp_ns: int
    points: "np.ndarray[tuple[int, ...], np.dtype[np.float32]]"
    T: RigidTransform
    path_m: float

    @classmethod
    def of(cls, stamp_ns: int, scan: Surface, T: RigidTransform, path_m: float) -> "KeyScan":
        """Return a scan to be kept."""
        return cls(stamp_ns, scan.points.astype(np.float32), T, path_m)

    def surface(self) -> Surface:
        """Return it to be registered."""
        return Surface(self.points.astype(np.float64))


def find_loop_closures(steps: Iterable[ScanStep], options: LoopOptions) -> tuple[LoopClosure, ...]:
    """Return the loop closures of a drive that are believed, in order of time.

    Memory grows with the path, by about 0.1 MB for each scan that is kept.

    Parameters
    ----------
    steps
        Scans with odometry, in order of time.
    options
        Where to search, and what to believe.
    """
    kept, loops = list[KeyScan](), list[LoopClosure]()
    path, last = 0.0, None
    for step in steps:
        path += float(np.linalg.norm(step.step.t))
        if last is not None and path - last < options.key_distance_m:
            continue
        last = path
        here = KeyScan.of(step.stamp_ns, step.surface, step.T_odom_lidar, path)
        for k in candidates(kept, here, options):
            first = kept[k].surface()
            work = closing_loop(kept[k], here, first, step.surface, options.registration)
            closed = completed(work)
            if isinstance(closed, LoopClosure):
                loops.append(closed)
        kept.append(here)
    return tuple(loops)


def candidates(kept: Sequence[KeyScan], here: KeyScan, options: LoopOptions) -> list[int]:
    """Return the rows of earlier scans that may be of the same place, the nearest first."""
    old = [k for k, each in enumerate(kept) if here.path_m - each.path_m >= options.least_way_m]
    away = [float(np.linalg.norm(kept[k].T.t - here.T.t)) for k in old]
    near = np.argsort(away)[: options.most].tolist()
    return [old[k] for k in near if away[k] <= options.search_m]


def closing_loop(
    earlier: KeyScan, here: KeyScan, first: Surface, scan: Surface, options: RegistrationOptions
) -> Generator[None, None, LoopClosure | Refusal]:
    """Return the loop closure between two scans, or why there is none.

    Yields between the registrations one way and the other.

    Parameters
    ----------
    earlier, here
        Both scans; their poses together tell where the second is looked for in the first.
    first, scan
        What they saw.
    options
        How they are registered.
    """
    guess = between(earlier.T, here.T)
    found = register(scan, first, guess, options)
    refusal = found.refusal(options)
    if refusal is None:
        yield
        refusal = register(first, scan, found.T.inverse(), options).refusal(options)
    if refusal is not None:
        return refusal
    estimate = by_scan(found, guess, options)
    return LoopClosure(earlier.stamp_ns, here.stamp_ns, estimate.T, estimate.covariance)

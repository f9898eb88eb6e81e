"""SLAM on line without a map, message by message: a dozen sensors whose calibrations are refined.

Ten key poses a second in laps of a hall of dipoles, with and without a scan each half second. Times
are those of processors, of all threads together. ``python -m benchmarks.online_exploring 3600``
drives an hour, which takes ten minutes, and with scans a quarter of an hour.
"""

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.memory import peak_mib
from l2m_gtsam.data import FloatArray, KnownSensor, Trajectory
from l2m_gtsam.lidar.loop_closures import LoopOptions
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.slam.drive import KnownSensors
from l2m_gtsam.slam.online.online_pose import OnlinePose
from l2m_gtsam.slam.online.replay import Message, give, messages, with_scans
from l2m_gtsam.slam.online.scan_matching import LoopMatcher
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.statistics import nees
from tests.drives.exploring import rms
from tests.drives.slam import SlamDrive, calibrated, laps, slam_drive
from tests.support.pose_errors import pose_nees
from tests.worlds.exact import dipole_world, random_sensors
from tests.worlds.lidar_rooms import ROOM, rows, scans

SENSORS, SMALL = 12, (1.9, 1.4)  # radii in metres of laps of 10 m
SEED, SECONDS, EVERY = 2, 200.0, 10  # duration of a drive; poses from scan to scan, of 20 a second
OFF = np.concatenate([np.full(3, 0.005), np.full(9, 0.005), np.full(3, 0.3)])  # m, -, uT
OPTIONS = SlamOptions.model_validate(
    {
        "key_poses": {"distance_m": 0.055, "readings": 1},
        "tiles": {"modes": 100},
        "calibration": "refined",
    }
)


@dataclass(frozen=True)
class Run:
    """A drive on line.

    Attributes
    ----------
    cost
        Processor time of each of K key poses, with all messages since the one before, s, (K,).
    off, drift
        Errors of position on line and by odometry in metres, shape (K,).
    nees
        Of each pose, shape (K,): 6 is consistent.
    sensors_nees
        Of the calibrations in the end, a sensor: 15 is consistent.
    grown
        Growth of the memory after the first tenth, MiB.
    """

    cost: FloatArray
    off: FloatArray
    drift: FloatArray
    nees: FloatArray
    sensors_nees: float
    grown: float

    @property
    def removed(self) -> float:
        """Share of odometry's error that is gone after the first third."""
        late = slice(len(self.off) // 3, None)
        return 1.0 - rms(self.off[late]) / rms(self.drift[late])


def drive_of(seed: int, seconds: float) -> tuple[tuple[KnownSensor, ...], SlamDrive]:
    known, truth = random_sensors(seed, SENSORS), laps(seconds, SMALL)
    return known, slam_drive(dipole_world(seed), known, truth, np.random.default_rng(seed))


def scans_of(drive: SlamDrive, seed: int) -> Iterator[Scan]:
    seen = rows(drive.truth, range(1, len(drive.truth), EVERY))
    return scans(ROOM, seen, np.random.default_rng(seed))


def timed(slam: OnlineSlam, given: Iterator[Message]) -> Iterator[tuple[OnlinePose, float]]:
    """Yield key poses as they are made, and the processor time since the one before."""
    cost = 0.0
    for message in given:
        begin = time.process_time()
        made = give(slam, message)
        cost += time.process_time() - begin
        for pose in made:
            yield pose, cost
            cost = 0.0
    begin = time.process_time()
    for pose in slam.finish():
        yield pose, cost + time.process_time() - begin
        cost, begin = 0.0, time.process_time()


def driven(seed: int, seconds: float, *, by_scans: bool) -> Run:
    """Drive through a hall on line, with calibrations that are off by what they state."""
    known, drive = drive_of(seed, seconds)
    start = calibrated(known, sigma=OFF, rng=np.random.default_rng(100 + seed))
    matcher: LoopMatcher | None = None
    given: Iterator[Message] = messages(drive.recording)
    if by_scans:
        largest = OPTIONS.robust.largest_of(6)
        matcher = LoopMatcher(LoopOptions(), OPTIONS.drift, largest)
        given = with_scans(given, scans_of(drive, seed))
    slam, warm, truth = OnlineSlam(start, OPTIONS, None, matcher), None, drive.truth
    made, costs = [], []  # without calibrations, which would fill the memory
    for pose, cost in timed(slam, given):
        if warm is None and pose.stamp_ns - truth.stamp_ns[0] > 1e8 * seconds:
            warm = peak_mib()
        made.append((pose.stamp_ns, pose.T_map_lidar.R, pose.T_map_lidar.t, pose.covariance))
        costs.append(cost)
    grown = 0.0 if warm is None else peak_mib() - warm
    stamps, R, p, covariance = (np.array(each) for each in zip(*made, strict=True))
    found = Trajectory(stamps, R, p, "map", "lidar", covariance)
    at = np.searchsorted(truth.stamp_ns, stamps)
    off, drift = (
        np.linalg.norm(each - truth.p[at], axis=1) for each in (p, drive.recording.trajectory.p[at])
    )
    own = sensors_nees(pose.sensors, known)
    return Run(np.array(costs), off, drift, pose_nees(truth[at], found), own, grown)


def sensors_nees(own: KnownSensors, known: tuple[KnownSensor, ...]) -> float:
    """Return the mean over sensors of the NEES of (t, C, H)."""
    error = own.vectors() - np.stack([each.vector() for each in known])
    return float(nees(error, own.covariance).mean())


def report(seconds: float) -> Table:
    table = Table(
        "scans", "seed", "times real time", "ms per key pose: median", "95 %", "99 %", "largest",
        "memory (MiB)", "grows by", "odometry (mm)", "on line", "removed", "NEES: poses", "sensors",
    )  # fmt: skip
    for by_scans in (False, True):
        run = driven(SEED, seconds, by_scans=by_scans)
        ms = 1e3 * np.quantile(run.cost, [0.5, 0.95, 0.99, 1.0])
        late = slice(len(run.off) // 3, None)
        table.add_row(
            "each 0.5 s" if by_scans else "none", f"{SEED}", f"{seconds / run.cost.sum():.1f}",
            *(f"{each:.1f}" for each in ms), f"{peak_mib():.0f}", f"{run.grown:.0f}",
            f"{1e3 * rms(run.drift[late]):.0f}", f"{1e3 * rms(run.off[late]):.0f}",
            f"{run.removed:.0%}", f"{run.nees[1:].mean():.2f}", f"{run.sensors_nees:.1f}",
        )  # fmt: skip
    return table


if __name__ == "__main__":
    Console(width=160).print(report(float(sys.argv[1]) if sys.argv[1:] else SECONDS))

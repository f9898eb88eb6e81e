"""SLAM with several sensors: cells of the study, and what each method makes of one drive."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, IntArray, Recording, Trajectory
from l2m_gtsam.options import Options
from l2m_gtsam.progress import silent
from l2m_gtsam.records.localisation import LocalisationResult
from l2m_gtsam.slam.exploration import explore
from l2m_gtsam.slam.localisation import localise, prepared
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.studies.measured import measured
from l2m_gtsam.studies.peers.exact_loops import closed_by_exact_loops
from l2m_gtsam.studies.peers.particle_filters import MapParticlesOptions, map_particles
from l2m_gtsam.studies.slam.methods import MethodRow, followed, rms
from l2m_gtsam.studies.slam_array.places import Drift, DriveInMap, strengths

RECORDINGS = (
    *(f"robot-{run}" for run in (1, 2, 3, 4)),
    "array-6",
)
APART_M = 0.1  # path between the steps of the particle filter
NEAR_M, WIDE_M = 0.3, 0.6  # reach of loops without errors


class SlamArrayOptions(Options):
    """Of the study of SLAM with several sensors."""

    data: str = "../shared/data"
    """Folder of the recordings, which are no part of this package."""
    recordings: tuple[str, ...] = RECORDINGS
    """Passes of the robot (`robot-1` to `robot-4`), runs of the array (`array-5` to `array-9`), and
    simulated places with their seeds (`warehouse-1`, `corridor-1`), of which each drive takes some
    twenty minutes."""
    seed: int = Field(default=0, ge=0)
    """The first;"""
    seeds: int = Field(default=2, ge=1)
    """and how many, of the drift's noise."""
    particles: MapParticlesOptions = MapParticlesOptions()
    """Parameters of the particle filter in the map."""


@dataclass(frozen=True)
class SlamArrayCell:
    """What the methods make of one drive with one odometry.

    Attributes
    ----------
    path_m, sensors
        Length of the true path, and number of sensors.
    odometry
        Odometry alone.
    particles, map_online, map_ours
        In the map: a particle filter on the field's strength, ``l2m slam`` on line and off line.
    online, ours
        Without a map: ``l2m slam`` on line and off line.
    near_loops_m, wide_loops_m
        Error that is left where loops of ``NEAR_M`` and ``WIDE_M`` are known without errors.
    """

    path_m: float
    sensors: int
    odometry: MethodRow
    particles: MethodRow
    map_online: MethodRow
    map_ours: MethodRow
    online: MethodRow
    ours: MethodRow
    near_loops_m: float
    wide_loops_m: float


def computed(options: SlamArrayOptions, key: str, drive: DriveInMap) -> SlamArrayCell:
    """Return a cell."""
    *_, kind, number = key.split("-")
    drift, seed, truth = Drift(kind), int(number), drive.truth
    odometry = drive.drifted[drift](truth, np.random.default_rng(seed))
    recording, chosen = drive.with_odometry(odometry), drive.options[drift]
    calibration, field_map = drive.calibration, drive.field_map
    in_map = measured(lambda: localise(recording, field_map, calibration, chosen, silent).result)
    explored = measured(lambda: explore(recording, calibration, chosen, silent).result)
    rows = np.searchsorted(truth.stamp_ns, in_map.result.trajectory.stamp_ns)

    def on_line(slam: Callable[[], OnlineSlam]) -> MethodRow:
        return MethodRow.of(measured(lambda: followed(recording, slam())), truth)

    return SlamArrayCell(
        path_m=float(np.linalg.norm(np.diff(truth.p, axis=0), axis=1).sum()),
        sensors=len(calibration.sensors),
        odometry=MethodRow.of_odometry(odometry[rows], truth[rows]),
        particles=MethodRow.of(
            measured(lambda: particles(options, drive, odometry, drift, seed)), truth
        ),
        map_online=on_line(lambda: OnlineSlam(calibration, chosen, field_map)),
        map_ours=MethodRow.of(in_map.of(in_map.result.trajectory), truth),
        online=on_line(lambda: OnlineSlam(calibration, chosen)),
        ours=MethodRow.of(
            explored.of(explored.result.trajectory),
            truth,
            unchanged=not is_gained(explored.result),
        ),
        near_loops_m=loops_rms(drive, recording, chosen, NEAR_M),
        wide_loops_m=loops_rms(drive, recording, chosen, WIDE_M),
    )


def loops_rms(
    place: DriveInMap, recording: Recording, options: SlamOptions, within_m: float
) -> float:
    """Return the error of odometry with all loops so near as they truly are, metres."""
    drive, _ = prepared(recording, place.calibration, options)
    drive = drive.as_recorded(drive.jumps)  # the recordings have no slips
    truth = place.truth[np.searchsorted(place.truth.stamp_ns, drive.stamp_ns)]
    closed = closed_by_exact_loops(drive, truth, within_m)
    return rms(np.stack([pose.translation() for pose in closed]), truth.p)


def is_gained(result: LocalisationResult) -> bool:
    """Return whether poses are corrected."""
    return result.gain is None or result.gain.shown


def particles(
    options: SlamArrayOptions, drive: DriveInMap, odometry: Trajectory, drift: Drift, seed: int
) -> Trajectory:
    """Return the poses of the particle filter, a step each ``APART_M`` of path."""
    rows = apart(odometry.p)
    steps = odometry[rows]
    return map_particles(
        steps,
        strengths(drive.recording, drive.calibration, steps.stamp_ns),
        np.stack([each.t_lidar_mag for each in drive.calibration.sensors]),
        drive.field_map,
        drive.options[drift].drift,
        options.particles,
        seed,
    )


def apart(p: FloatArray) -> IntArray:
    """Return rows of positions, shape (N, 3), the first at each ``APART_M`` of their path."""
    path = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1)))
    pieces = (path / APART_M).astype(np.int64)
    return np.append(0, 1 + np.flatnonzero(np.diff(pieces)))

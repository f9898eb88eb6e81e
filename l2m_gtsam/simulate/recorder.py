"""What a vehicle's sensors record while it drives."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FieldSeries, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.progress import Progress
from l2m_gtsam.simulate.drive import VehicleMotion
from l2m_gtsam.simulate.lidar import SimulatedScans
from l2m_gtsam.simulate.sensors import (
    NANOSECONDS,
    NoiseOptions,
    SamplingOptions,
    measured_poses,
    read_field,
    sample_stamps,
    sensor_points,
)
from l2m_gtsam.simulate.world import SteelWorld


@dataclass(frozen=True)
class Vehicle:
    """A vehicle on its drive.

    Attributes
    ----------
    motion
        Where its lidar truly is.
    sampling, noise
        When and how well it measures.
    """

    name: str
    sensors: tuple[KnownSensor, ...]
    motion: VehicleMotion
    sampling: SamplingOptions
    noise: NoiseOptions


@dataclass(frozen=True)
class SimulatedDrive:
    """One drive: what was recorded, the true motion behind it, and the scans if there are any."""

    recording: Recording
    motion: VehicleMotion
    scans: SimulatedScans | None = None

    def truth(self) -> Trajectory:
        """Return the true poses of the lidar at the times of those that were recorded."""
        return self.motion.at(self.recording.trajectory.stamp_ns)

    def with_poses(self, trajectory: Trajectory) -> "SimulatedDrive":
        """Return the drive with other poses recorded."""
        recording = self.recording
        source = replace(recording.source, sha256=_digest(trajectory, recording.series))
        return replace(self, recording=replace(recording, trajectory=trajectory, source=source))


def record(
    vehicle: Vehicle, world: SteelWorld, rng: np.random.Generator, progress: Progress
) -> SimulatedDrive:
    """Return what a vehicle records on its drive through a world.

    Every source has its own clock phase and jitter; stamps are the true times of measurement,
    those of readings less ``SamplingOptions.clock_offset``.

    Raises
    ------
    ConfigError
        A sensor would pass through steel.
    """
    motion, sampling = vehicle.motion, vehicle.sampling
    stamps = sample_stamps(sampling, sampling.pose_rate, motion.duration, rng)
    trajectory = measured_poses(motion.at(motion.start_ns + stamps), vehicle.noise, rng)
    series: list[FieldSeries] = []
    for sensor in vehicle.sensors:
        progress(f"simulate {vehicle.name} drive", len(series) / len(vehicle.sensors))
        series.append(_record_sensor(vehicle, sensor, world, rng))
    progress(f"simulate {vehicle.name} drive", 1.0)
    source = SourceFile(f"simulated {vehicle.name} drive", _digest(trajectory, series))
    return SimulatedDrive(Recording(trajectory, tuple(series), source), motion)


def _record_sensor(
    vehicle: Vehicle, sensor: KnownSensor, world: SteelWorld, rng: np.random.Generator
) -> FieldSeries:
    """Return what one sensor records, on a topic and in a frame of its own name."""
    motion, sampling = vehicle.motion, vehicle.sampling
    stamps = sample_stamps(sampling, sampling.field_rate, motion.duration, rng)
    poses = motion.at(motion.start_ns + stamps)
    if world.inside(sensor_points(poses, sensor)).any():
        raise ConfigError(
            f"{vehicle.name} drive: sensor {sensor.sensor} would pass through steel; leave more "
            "clearance between route and racks, or place the sensor nearer to the lidar"
        )
    field = read_field(world, poses, sensor, vehicle.noise, rng)
    stamp_ns = poses.stamp_ns - round(sampling.clock_offset * NANOSECONDS)
    return FieldSeries(sensor.sensor, f"/{sensor.sensor}", sensor.sensor, stamp_ns, field)


def _digest(trajectory: Trajectory, series: Sequence[FieldSeries]) -> str:
    """Return the SHA-256 of all arrays of a recording."""
    digest = hashlib.sha256()
    for array in (trajectory.stamp_ns, trajectory.R, trajectory.p):
        digest.update(np.ascontiguousarray(array).tobytes())
    for entry in series:
        digest.update(entry.stamp_ns.tobytes() + entry.field.tobytes())
    return digest.hexdigest()

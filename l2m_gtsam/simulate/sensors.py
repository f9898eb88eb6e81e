"""Magnetometers on a vehicle: where they sit, how they distort, what they read."""

from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.linalg import solve_banded
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, IntArray, KnownSensor, Trajectory
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.world import SteelWorld

NANOSECONDS = 1e9


class NoiseOptions(Options):
    """Noise of readings and poses."""

    field: Annotated[float, Field(ge=0)] = 0.1
    """Standard deviation of a reading per axis in microtesla. The RM3100's data sheet states
    15 nT at 200 cycles, with steps of 13 nT; a vehicle's currents make up the rest."""
    position: Annotated[float, Field(ge=0)] = 0.003
    """Standard deviation of a pose's position per axis in metres."""
    rotation: Annotated[float, Field(ge=0)] = 0.05
    """Standard deviation of a pose's rotation per axis in degrees."""
    pose_correlation: Annotated[float, Field(ge=0)] = 0.0
    """How long the errors of poses last in seconds: the correlation of two of them falls to 1/e
    over this time. 0 gives every pose an error of its own."""


class SensorArrayOptions(Options):
    """The array of magnetometers to be calibrated, on rings about the lidar's vertical axis."""

    count: Annotated[int, Field(ge=1, le=100)] = 12
    """Number of magnetometers."""
    inner_radius: Annotated[float, Field(gt=0)] = 0.30
    """Distance of every other sensor from the lidar's vertical axis in metres."""
    outer_radius: Annotated[float, Field(gt=0)] = 0.45
    """Distance of the other sensors from the lidar's vertical axis in metres."""
    heights: Annotated[tuple[float, ...], Field(min_length=1)] = (-0.10, -0.25, -0.40)
    """Heights relative to the lidar in metres that the sensors take in turn."""
    placing: Annotated[float, Field(ge=0)] = 0.02
    """Largest random shift of each sensor's place along each axis in metres."""
    misalignment: Annotated[float, Field(ge=0)] = 3.0
    """Standard deviation of the mounting rotation about each axis in degrees."""
    scale: Annotated[float, Field(ge=0)] = 0.03
    """Standard deviation of each axis' scale error."""
    soft_iron: Annotated[float, Field(ge=0)] = 0.02
    """Standard deviation of the coupling between each two axes by soft iron."""
    offset: Annotated[float, Field(ge=0)] = 20.0
    """Largest offset per axis in microtesla: hard iron and electronics."""


class MappingSuiteOptions(Options):
    """The mapping vehicle's own magnetometers, known and free of distortion."""

    lateral: Annotated[tuple[float, ...], Field(min_length=1)] = (-0.4, 0.0, 0.4)
    """Positions to the left of the lidar in metres."""
    heights: Annotated[tuple[float, ...], Field(min_length=1)] = (-0.5, -0.2, 0.1)
    """Heights relative to the lidar in metres; two at least show the map a vertical gradient."""


class SamplingOptions(Options):
    """When poses and readings are taken."""

    pose_rate: Annotated[float, Field(gt=0)] = 20.0
    """Poses per second."""
    field_rate: Annotated[float, Field(gt=0)] = 20.0
    """Readings per second of each magnetometer."""
    jitter: Annotated[float, Field(ge=0, lt=0.5)] = 0.1
    """Largest deviation of a stamp from its regular time, as a share of the interval."""
    clock_offset: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """How far the magnetometers' clocks are behind the poses' clock in seconds: a reading was
    taken at its stamp plus this."""


def random_array(options: SensorArrayOptions, rng: np.random.Generator) -> tuple[KnownSensor, ...]:
    """Return magnetometers at varied places with random distortions.

    C is a symmetric positive matrix (scale errors on its diagonal, soft iron beside it) times a
    small mounting rotation, so that the rotation is exactly the polar factor of C.

    Parameters
    ----------
    options
        Spread of places and distortions.
    """
    return tuple(
        KnownSensor(f"mag_{index:02d}", place, random_distortion(options, rng))
        for index, place in enumerate(_random_places(options, rng))
    )


def random_distortion(options: SensorArrayOptions, rng: np.random.Generator) -> Distortion:
    """Return a random C and H; see ``random_array``."""
    R_mag_lidar = Rotation.from_rotvec(
        rng.normal(0.0, np.deg2rad(options.misalignment), 3)
    ).as_matrix()
    # C = S R with a symmetric S near the identity: positive, so that R is C's polar factor.
    coupling = np.triu(rng.normal(0.0, options.soft_iron, (3, 3)), 1)
    stretch = np.diag(1 + rng.normal(0.0, options.scale, 3)) + coupling + coupling.T
    offset = rng.uniform(-options.offset, options.offset, 3)
    return Distortion(stretch @ R_mag_lidar, offset)


def mapping_suite(options: MappingSuiteOptions) -> tuple[KnownSensor, ...]:
    """Return ideal magnetometers in an upright grid across the vehicle."""
    places = [(0.0, y, z) for z in options.heights for y in options.lateral]
    return tuple(
        KnownSensor(f"suite_{index:02d}", np.array(place), Distortion.identity())
        for index, place in enumerate(places)
    )


def sample_stamps(
    options: SamplingOptions, rate: float, duration: float, rng: np.random.Generator
) -> IntArray:
    """Return jittered stamps from 0 to ``duration`` seconds, in nanoseconds, ascending.

    The first stamp lies at a random share of the interval: sources are not synchronised.
    """
    regular = np.arange(int(duration * rate)) + rng.uniform()
    jitter = rng.uniform(-options.jitter, options.jitter, len(regular))
    seconds = np.clip((regular + jitter) / rate, 0.0, duration)
    return np.unique(np.round(seconds * NANOSECONDS).astype(np.int64))


def read_field(
    world: SteelWorld,
    poses: Trajectory,
    sensor: KnownSensor,
    noise: NoiseOptions,
    rng: np.random.Generator,
) -> FloatArray:
    """Return what a sensor reads along true poses, ``C R^T B(R t + p) + H`` plus noise.

    Parameters
    ----------
    poses
        True poses of the lidar in the map, one per reading.
    sensor
        Place and distortion.
    noise
        White noise of the reading.

    Returns
    -------
    Readings in the sensor's frame in microtesla, shape (N, 3).
    """
    field = world.field(sensor_points(poses, sensor))
    b_lidar = np.einsum("nij,ni->nj", poses.R, field)
    exact = sensor.distortion.apply(b_lidar)
    return exact + rng.normal(0.0, noise.field, exact.shape)


def sensor_points(poses: Trajectory, sensor: KnownSensor) -> FloatArray:
    """Return a sensor's positions in the map along poses in metres, shape (N, 3)."""
    return np.asarray(poses.R @ sensor.t_lidar_mag + poses.p)


def measured_poses(poses: Trajectory, noise: NoiseOptions, rng: np.random.Generator) -> Trajectory:
    """Return poses as odometry would report them, and their covariances.

    Parameters
    ----------
    noise
        Errors of the rotation about the lidar's axes and of the position along the map's axes.
    """
    sigmas = np.deg2rad(noise.rotation), noise.position
    white = [rng.normal(0.0, sigma, (len(poses), 3)) for sigma in sigmas]
    turn, shift = (lasting(part, poses.stamp_ns, noise.pose_correlation) for part in white)
    R = poses.R @ Rotation.from_rotvec(turn).as_matrix()
    # The same along all axes, and so the same in every frame.
    covariance = np.tile(np.diag(np.repeat(sigmas, 3) ** 2), (len(poses), 1, 1))
    return Trajectory(
        poses.stamp_ns, R, poses.p + shift, poses.frame, poses.child_frame, covariance
    )


def lasting(white: FloatArray, stamp_ns: IntArray, correlation: float) -> FloatArray:
    """Return noise that lasts: a stationary Ornstein-Uhlenbeck process at irregular times.

    Parameters
    ----------
    white
        Independent values, shape (N, K); the process has their variance.
    stamp_ns
        Times in nanoseconds, ascending, shape (N,).
    correlation
        Time in seconds over which the correlation falls to 1/e; 0 returns ``white``.

    Returns
    -------
    Shape (N, K).
    """
    if correlation == 0:
        return white
    lapse = np.diff(stamp_ns) / (NANOSECONDS * correlation)
    fresh = np.ones(len(white))
    # 1 - exp(-2 lapse) without cancellation where poses are frequent.
    fresh[1:] = np.sqrt(-np.expm1(-2 * lapse))
    # x[k] - exp(-lapse[k]) x[k - 1] = fresh[k] white[k], all k at once
    bands = np.ones((2, len(white)))
    bands[1, :-1] = -np.exp(-lapse)
    return np.asarray(solve_banded((1, 0), bands, fresh[:, None] * white))


def _random_places(options: SensorArrayOptions, rng: np.random.Generator) -> FloatArray:
    """Return positions in the lidar frame in metres, shape (count, 3)."""
    index = np.arange(options.count)
    angle = 2 * np.pi * index / options.count
    radius = np.where(index % 2 == 0, options.outer_radius, options.inner_radius)
    height = np.resize(options.heights, options.count)
    places = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    return places + rng.uniform(-options.placing, options.placing, places.shape)

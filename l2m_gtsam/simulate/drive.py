"""How a vehicle moves along a route."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.options import Options

NANOSECONDS = 1e9
PATH_STEP = 0.02  # metres between points of a rounded path
TIME_STEP = 0.05  # seconds between knots of the motion's splines
SWAY_WAVES = 6  # sinusoids that make up each of roll, pitch and heave


class DriveOptions(Options):
    """How fast and how steadily a vehicle drives."""

    speed: Annotated[float, Field(gt=0)] = 1.0
    """Speed on straights in metres per second."""
    yaw_rate: Annotated[float, Field(gt=0)] = 1.0
    """Largest yaw rate in radians per second; the vehicle slows down in turns to keep it."""
    acceleration: Annotated[float, Field(gt=0)] = 0.4
    """Acceleration at the start and braking at the end, in metres per second squared."""
    rounding: Annotated[float, Field(gt=0)] = 0.3
    """Length over which corners of the route are smoothed, in metres (Gaussian)."""
    lidar_height: Annotated[float, Field(gt=0)] = 0.8
    """Height of the lidar above the floor in metres."""
    roll: Annotated[float, Field(ge=0, lt=45)] = 1.5
    """Bound of the roll angle in degrees."""
    pitch: Annotated[float, Field(ge=0, lt=45)] = 1.5
    """Bound of the pitch angle in degrees."""
    heave: Annotated[float, Field(ge=0)] = 0.015
    """Bound of the vertical motion in metres."""
    sway_slowest: Annotated[float, Field(gt=0)] = 0.1
    """Lowest frequency of roll, pitch and heave in hertz."""
    sway_fastest: Annotated[float, Field(gt=0)] = 0.7
    """Highest frequency of roll, pitch and heave in hertz."""


@dataclass(frozen=True)
class VehicleMotion:
    """The true motion of a lidar in the map, smooth in time.

    Attributes
    ----------
    start_ns
        Time of the start in nanoseconds.
    duration
        Length of the drive in seconds.
    position
        Position in the map in metres over seconds since the start, three values.
    attitude
        Yaw, pitch and roll in radians over seconds since the start, three values:
        R_map_lidar = Rz(yaw) Ry(pitch) Rx(roll).
    """

    start_ns: int
    duration: float
    position: CubicSpline[np.float64]
    attitude: CubicSpline[np.float64]

    def at(self, stamp_ns: IntArray) -> Trajectory:
        """Return the true poses of the lidar at these times, shape (N,), in nanoseconds."""
        seconds = (stamp_ns - self.start_ns) / NANOSECONDS
        R = Rotation.from_euler("ZYX", self.attitude(seconds)).as_matrix()
        return Trajectory(stamp_ns, R, self.position(seconds), "map", "lidar")


def drive(
    options: DriveOptions, route: FloatArray, start_ns: int, rng: np.random.Generator
) -> VehicleMotion:
    """Return the motion of a vehicle along a route.

    The route's corners are rounded, the vehicle slows down where the rounded path bends, and
    heads where it drives. Roll and pitch turn about the lidar, which heaves about its height.

    Parameters
    ----------
    route
        Corner points in the map in metres, shape (M, 2).
    start_ns
        Time of the start in nanoseconds.
    rng
        Source of randomness of roll, pitch and heave.
    """
    path = _rounded(route, options.rounding)
    step = np.gradient(path, axis=0)
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    travelled = cumulative_trapezoid(np.linalg.norm(step, axis=1), initial=0)
    speed = _speed(options, travelled, yaw)
    time = cumulative_trapezoid(1 / speed, travelled, initial=0)

    knots = np.linspace(0.0, time[-1], int(np.ceil(time[-1] / TIME_STEP)) + 1)
    x, y, heading = (np.interp(knots, time, values) for values in (*path.T, yaw))
    heave, pitch, roll = (
        bound * _sway(options, knots, rng)
        for bound in (options.heave, np.deg2rad(options.pitch), np.deg2rad(options.roll))
    )
    return VehicleMotion(
        start_ns,
        float(time[-1]),
        CubicSpline(knots, np.column_stack([x, y, options.lidar_height + heave])),
        CubicSpline(knots, np.column_stack([heading, pitch, roll])),
    )


def _rounded(route: FloatArray, rounding: float) -> FloatArray:
    """Return a smooth path near a route, points PATH_STEP apart or nearer, shape (P, 2)."""
    moves = np.linalg.norm(np.diff(route, axis=0), axis=1) > 0
    corners = route[np.concatenate([[True], moves])]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    places = np.linspace(0.0, travelled[-1], int(travelled[-1] / PATH_STEP) + 2)
    dense = np.column_stack([np.interp(places, travelled, axis) for axis in corners.T])
    # Continued straight beyond both ends, so that smoothing leaves the ends where they are.
    beyond = min(int(np.ceil(4 * rounding / PATH_STEP)), len(dense) - 1)
    longer = np.pad(dense, ((beyond, beyond), (0, 0)), "reflect", reflect_type="odd")
    smooth = gaussian_filter1d(longer, rounding / PATH_STEP, axis=0)
    return np.asarray(smooth[beyond : len(smooth) - beyond])


def _speed(options: DriveOptions, travelled: FloatArray, yaw: FloatArray) -> FloatArray:
    """Return the speed in metres per second at each place of a path, shape (P,)."""
    # The yaw rate is the bend (rad/m) times the speed.
    bend = np.abs(np.gradient(yaw, travelled))
    wanted = options.speed / np.maximum(1.0, bend * options.speed / options.yaw_rate)
    # The least within the smoothing's reach first, so that the mean stays below every limit.
    reach = int(np.ceil(2 * options.rounding / PATH_STEP))
    least = minimum_filter1d(wanted, 2 * reach + 1, mode="nearest")
    steady = gaussian_filter1d(least, reach / 2, mode="nearest", radius=reach)
    from_end = np.minimum(travelled, travelled[-1] - travelled)
    # A creep of 5 cm/s instead of rest, where the time would not end.
    # v^2 = 2 a s at constant acceleration.
    ramp = np.sqrt(0.05**2 + 2 * options.acceleration * from_end)
    return np.asarray(np.minimum(steady, ramp))


def _sway(options: DriveOptions, time: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return a smooth random signal within -1 and 1 at each time, shape (T,)."""
    # Amplitudes that add up to one bound the sum of the waves by one.
    share = rng.dirichlet(np.ones(SWAY_WAVES))
    frequency = rng.uniform(options.sway_slowest, options.sway_fastest, SWAY_WAVES)
    phase = rng.uniform(0.0, 2 * np.pi, SWAY_WAVES)
    return np.asarray(np.sin(2 * np.pi * np.outer(time, frequency) + phase) @ share)

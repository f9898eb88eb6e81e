"""All processes that are looked for on a drive, and those of single sensors: clocks, filters."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_factors import PoseMotion, field_rate
from l2m_gtsam.calibration.budget.processes import (
    WANDER_MODES,
    FieldProcess,
    PoseProcess,
    Process,
    ReadingPlaces,
    TimeModes,
    Wander,
    Warp,
    times_modes,
)
from l2m_gtsam.data import FloatArray, IntArray, LidarMotion, Readings
from l2m_gtsam.records.error_budget import DisturbanceKind
from l2m_gtsam.solve.linear_algebra import right_divided

CLOCK_MODES = 8  # slower ones hold all but a thousandth of a steady drift's variance
LAGGING_S = 0.015  # a filter that delays by less smooths by less, which does not show
NAMES = ("turning_ut", "steering_ut", "speed_ut", "acceleration_ut")
WHEELBASE_M = 1.0  # for the angle of steering: sin of it is w L / sqrt((w L)^2 + v^2)
CREEPING_M_S = 0.1  # slower, poses do not tell how far a vehicle steers
STILL = 1e-3  # rad/s, m/s, m/s^2: what varies less does not vary


@dataclass(frozen=True)
class ClockDrift(Process):
    """A clock that drifts: the time offset of a sensor is not constant over a drive.

    A crystal is off by some 1e-5 of the time, stamps of a driver that buffers by 1e-4 and more: 100
    ms in three minutes. The offset of the middle of a drive is a variable of the graph; the rest is
    a random walk about it, of which a steady drift is the slowest modes.
    """

    sensor: int
    modes: TimeModes
    kind = DisturbanceKind.CLOCK

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of a random walk, s^2."""
        return (1 / np.square(np.pi * self.modes.frequency)[None],)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what seconds of delay make of the field on the way, shape (n, 3, m)."""
        places, readings = self.places, self.places.readings
        motion = None
        if readings.motion is not None:
            known = readings.motion[rows]
            motion = PoseMotion(known.twist_lidar, known.offset)
        slope = places.slope[rows] @ readings.R_map_lidar[rows]
        rate = field_rate(places.b_lidar[rows], slope, places.t[rows], motion)
        return times_modes(rate[:, :, None], self.modes.values(readings, rows))

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return how far the clock walks."""
        return {"drift_s": float(np.sqrt(sizes.sum()))}


@dataclass(frozen=True)
class Smoothing(Process):
    r"""A sensor that smooths its readings, by a low-pass filter or a mean over some time.

    With h(s) how much of a reading is of the field s seconds ago, m the mean of s and v its
    variance,

    .. math::
        \int h(s)\, b(\tau - s)\, ds = b(\tau - m) + \tfrac{v}{2}\, \ddot b(\tau - m) + \dots

    The mean is a time offset, a variable of the graph; the variance is the weight of one mode. A
    filter of first order with a time constant of T has a mean of T and a variance of T^2, a mean
    over a time W has W / 2 and W^2 / 12.
    """

    sensor: int
    kind = DisturbanceKind.SMOOTHING

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of a variance in s^2, whose own is one."""
        return (np.ones((1, 1)),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what a variance does to the field, uT/s^2 in the lidar frame, shape (n, 3, 1)."""
        if self.places.bend is None:
            return np.zeros((len(rows), 3, 1))
        return np.asarray(0.5 * self.places.bend[rows, :, None])

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return over how long readings are means: the standard deviation of the time."""
        return {"smoothing_s": float(sizes[0] ** 0.25)}


@dataclass(frozen=True)
class MotionUnits:
    """How a vehicle moves on a drive.

    Attributes
    ----------
    deviation
        Standard deviations over the drive of its rate of turn in rad/s, the sine of its steering,
        its speed in m/s, its acceleration in m/s^2, shape (4,); infinite for what does not vary.
    """

    deviation: FloatArray

    @classmethod
    def over(cls, readings: Readings, motion: LidarMotion) -> "MotionUnits":
        """Return that of some readings."""
        deviation = motion_numbers(readings.R_map_lidar, motion).std(axis=0)
        return cls(np.where(deviation > STILL, deviation, np.inf))

    def values(self, readings: Readings, rows: IntArray) -> FloatArray:
        """Return its numbers in units of that, shape (n, 4); zero where motion is not known."""
        if readings.motion is None:
            return np.zeros((len(rows), len(NAMES)))
        numbers = motion_numbers(readings.R_map_lidar[rows], readings.motion[rows])
        return np.asarray(numbers / self.deviation)


def motion_numbers(R_map_lidar: FloatArray, motion: LidarMotion) -> FloatArray:
    """Return rate of turn about the vertical, steering, speed, acceleration along the way, (N, 4).

    They are the same however the lidar is mounted.
    """
    w, v = motion.twist_lidar[:, :3], motion.twist_lidar[:, 3:]
    speed = np.linalg.norm(v, axis=1)
    along = np.einsum("ni,ni->n", v, motion.acceleration_lidar[:, 3:])
    along = np.divide(along, speed, out=np.zeros_like(speed), where=speed > STILL)
    turning = np.einsum("ni,ni->n", R_map_lidar[:, 2], w)
    turned = turning * WHEELBASE_M
    steering = turned / np.sqrt(turned**2 + speed**2 + CREEPING_M_S**2)
    return np.column_stack([turning, steering, speed, along])


@dataclass(frozen=True)
class MovingParts(Process):
    """H that follows how the vehicle moves: iron that steers, currents of motors, loads that tilt.

    Where such a number was recorded it is a regressor (``moving_solve``). Where none was, how fast
    the vehicle turns, how far it steers, its speed and its acceleration stand for it, each with
    three weights along the axes of the sensor. They are in units of their standard deviations over
    the drive. H is that of a vehicle that stands, its wheels straight.
    """

    sensor: int
    motion: MotionUnits
    kind = DisturbanceKind.MOVING_PARTS

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of what follows each, uT^2 for a standard deviation of it."""
        return (np.repeat(np.eye(len(NAMES)), 3, axis=1),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what adds to the readings along their axes, shape (n, 3, 12)."""
        along = right_divided(np.eye(3), self.places.C[rows])
        return times_modes(along, self.motion.values(self.places.readings, rows))

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return what follows each, uT."""
        return dict(zip(NAMES, np.sqrt(sizes).tolist(), strict=True))


# Of each of six errors of poses, and of fields: what lasts a second is half a wave of 1.75 s and
# more. With fewer modes than that, errors of poses look like fields.
FINEST_S = 1.75
FAST_MODES = (48, 96)  # at least and at most: a thousand weights take seconds


def processes(
    places: ReadingPlaces, sensors: Sequence[int], lagging: Sequence[int] = ()
) -> tuple[Process, ...]:
    """Return all that is looked for; errors of poses only where none are stated.

    Parameters
    ----------
    places
        What readings are taken at.
    sensors
        Whose readings they are.
    lagging
        Sensors that may have a filter: one delays by as much as it smooths. Noise of poses that
        is new with each looks like one, too: their mean over a moment is better than each.
    """
    readings = places.readings
    slow = TimeModes.over(readings, WANDER_MODES)
    found: list[Process] = [Wander(places, sensor, slow) for sensor in sensors]
    if readings.motion is not None:
        slowest = TimeModes.over(readings, CLOCK_MODES)
        found += [ClockDrift(places, sensor, slowest) for sensor in sensors]
        filtered = lagging if readings.pose_root is None else ()
        found += [Smoothing(places, sensor) for sensor in filtered]
        vehicle = MotionUnits.over(readings, readings.motion)
        found += [MovingParts(places, sensor, vehicle) for sensor in sensors]
    count = int(np.clip(np.ceil(slow.duration.max() / FINEST_S), *FAST_MODES))
    fast = TimeModes.over(readings, count)
    if len(sensors) > 1:  # of one sensor's wander it cannot be told
        found.append(FieldProcess(places, fast))
    if readings.pose_root is None:
        found.append(PoseProcess(places, fast))
    return (*found, Warp.of(places))

"""H that follows how the vehicle moves: iron that steers, currents of motors, a load that tilts.

Where such a number was recorded it is a regressor (``moving_solve``). Where none was, how fast the
vehicle turns, how far it steers, its speed and its acceleration stand for it, each with three
weights along the axes of the sensor. They are in units of their standard deviations over the drive.
H is that of a vehicle that stands, its wheels straight.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_gtsam.calibration.budget.processes import Process, times_modes
from l2m_gtsam.data import FloatArray, IntArray, LidarMotion, Readings
from l2m_gtsam.records.error_budget import DisturbanceKind
from l2m_gtsam.solve.linear_algebra import right_divided

NAMES = ("turning_ut", "steering_ut", "speed_ut", "acceleration_ut")
WHEELBASE_M = 1.0  # for the angle of steering: sin of it is w L / sqrt((w L)^2 + v^2)
CREEPING_M_S = 0.1  # slower, poses do not tell how far a vehicle steers
STILL = 1e-3  # rad/s, m/s, m/s^2: what varies less does not vary


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
    """H of a sensor follows the vehicle's motion."""

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

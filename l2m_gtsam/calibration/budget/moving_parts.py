"""H that follows how the vehicle moves: iron that steers, currents of motors, a load that tilts.

Where such a number was recorded it is a regressor (``moving_solve``). Where none was, how fast the
vehicle turns, its speed and its acceleration stand for it, each with three weights along the axes
of the sensor. They are in units of their standard deviations over the drive. H is that of a vehicle
that stands.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from l2m_gtsam.calibration.budget.processes import ReadingPlaces, times_modes
from l2m_gtsam.data import FloatArray, IntArray, LidarMotion, Readings
from l2m_gtsam.records.error_budget import DisturbanceKind
from l2m_gtsam.solve.linear_algebra import right_divided

NAMES = ("turning_ut", "speed_ut", "acceleration_ut")
STILL = 1e-3  # rad/s, m/s, m/s^2: what varies less does not vary


@dataclass(frozen=True)
class VehicleMotion:
    """How a vehicle moves on a drive.

    Attributes
    ----------
    deviation
        Standard deviations over the drive of its rate of turn in rad/s, its speed in m/s, its
        acceleration in m/s^2, shape (3,); infinite for what does not vary.
    """

    deviation: FloatArray

    @classmethod
    def over(cls, readings: Readings, motion: LidarMotion) -> "VehicleMotion":
        """Return that of some readings."""
        deviation = motion_numbers(readings.R_map_lidar, motion).std(axis=0)
        return cls(np.where(deviation > STILL, deviation, np.inf))

    def values(self, readings: Readings, rows: IntArray) -> FloatArray:
        """Return them in units of that, shape (n, 3); zero where it is not known."""
        if readings.motion is None:
            return np.zeros((len(rows), len(NAMES)))
        numbers = motion_numbers(readings.R_map_lidar[rows], readings.motion[rows])
        return np.asarray(numbers / self.deviation)


def motion_numbers(R_map_lidar: FloatArray, motion: LidarMotion) -> FloatArray:
    """Return rate of turn about the vertical, speed and acceleration along the way, shape (N, 3).

    They are the same however the lidar is mounted.
    """
    w, v = motion.twist_lidar[:, :3], motion.twist_lidar[:, 3:]
    speed = np.linalg.norm(v, axis=1)
    along = np.einsum("ni,ni->n", v, motion.acceleration_lidar[:, 3:])
    along = np.divide(along, speed, out=np.zeros_like(speed), where=speed > STILL)
    return np.column_stack([np.einsum("ni,ni->n", R_map_lidar[:, 2], w), speed, along])


@dataclass(frozen=True)
class MovingParts:
    """H of a sensor follows the vehicle's motion."""

    places: ReadingPlaces
    sensor: int
    motion: VehicleMotion
    kind: DisturbanceKind = DisturbanceKind.MOVING_PARTS

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of what follows turns, speed and acceleration, uT^2 for a standard deviation of each."""
        return (np.repeat(np.eye(len(NAMES)), 3, axis=1),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what adds to the readings along their axes, shape (n, 3, 9)."""
        along = right_divided(np.eye(3), self.places.C[rows])
        return times_modes(along, self.motion.values(self.places.readings, rows))

    def on(self, places: ReadingPlaces) -> "MovingParts":
        """Return the same in other readings."""
        return replace(self, places=places)

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return what follows each, uT."""
        return dict(zip(NAMES, np.sqrt(sizes).tolist(), strict=True))

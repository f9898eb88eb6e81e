"""What comes out of a plan: frozen records, with shapes and units.

Frames and units are those of ``data``.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.by_sensor import BySensor
from l2m_gtsam.records.calibration import Uncertainty


class NoiseSource(StrEnum):
    """Where the noise that a plan assumes is from."""

    GIVEN = "given"
    """`calibration.solve.sensor_noise_ut` states it."""
    MAP = "map"
    """The map has that of the sensors that surveyed it."""
    ASSUMED = "assumed"
    """`plan.noise_ut`: nothing else is known."""


@dataclass(frozen=True)
class SensorPlan:
    """What a drive will determine of one sensor.

    Attributes
    ----------
    sensor
        Name.
    t_lidar_mag
        Where it is assumed in the lidar frame in metres, shape (3,).
    readings, outside_map
        Readings that will be used, and those for which the map has no data.
    covariance
        Of (t, C row by row, H) in m and uT, shape (15, 15); infinite on the diagonal for what
        will not be determined.
    rotation_covariance
        Of the rotation error in the sensor frame in rad^2, shape (3, 3).
    undetermined
        What will not be determined, a sentence for each reason with the parameters by name.
    offset_sigma
        Of the time offset in seconds, infinite where it will be held.
    offset_held
        Why it will be held at zero; empty where it will be estimated.
    from_priors
        What the readings will leave open and only priors determine, as of a calibration.
    """

    sensor: str
    t_lidar_mag: FloatArray
    readings: int
    outside_map: int
    covariance: FloatArray
    rotation_covariance: FloatArray
    undetermined: tuple[str, ...]
    offset_sigma: float = float("inf")
    offset_held: str = ""
    from_priors: tuple[str, ...] = ()

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of (t, C row by row, H) in m and uT, shape (15,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Worst:
    """The parameter of a sensor that is known least, in largest useful sigmas of its kind.

    Attributes
    ----------
    undetermined
        Number of its parameters without any sigma.
    sensor
        Its name.
    parameter
        The least known of the others, by name; empty if there is none.
    sigma
        Of it in its own unit.
    share
        The same in largest useful sigmas.
    """

    undetermined: int
    sensor: str
    parameter: str
    sigma: float
    share: float

    @property
    def badness(self) -> tuple[int, float]:
        """What a better drive has less of; parameters without a sigma count first."""
        return self.undetermined, self.share


@dataclass(frozen=True)
class MotionPlan:
    """What would be known least if a motion were added to the drive."""

    motion: str
    worst: Worst


@dataclass(frozen=True)
class DrivePlan(BySensor[SensorPlan]):
    """What a drive will determine and what would help.

    Attributes
    ----------
    sensors
        One entry per sensor.
    noise
        Standard deviation of the sensors' noise in uT that is assumed, of each the same.
    noise_source
        Where it is from.
    uncertainty
        How the map's errors are counted.
    worst
        What is known least of the sensor that is known least, by itself: without what the readings
        of others determine of the map's errors.
    motions
        The same with an extra motion, the most helpful first.
    doubts
        What speaks against the map, and therefore against the sigmas, a sentence each.
    notes
        What else is worth knowing, likewise.
    """

    sensors: tuple[SensorPlan, ...]
    noise: float
    noise_source: NoiseSource
    uncertainty: Uncertainty
    worst: Worst
    motions: tuple[MotionPlan, ...]
    doubts: tuple[str, ...]
    notes: tuple[str, ...] = ()

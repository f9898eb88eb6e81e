"""What comes out of a localisation: frozen records, with shapes and units."""

from dataclasses import dataclass
from enum import StrEnum

from l2m_gtsam.data import SourceFile, Trajectory
from l2m_gtsam.metric_records import Record
from l2m_gtsam.results import CalibrationResult


class LocalisationStatus(StrEnum):
    """How a localisation ended."""

    LOCALISED = "localised"
    NOT_CONVERGED = "not_converged"
    OUTSIDE_MAP = "outside_map"
    NOT_HERE = "not_here"


@dataclass(frozen=True)
class DriftFigures(Record):
    """How far odometry, from where the drive is said to begin, is from the localised poses.

    Attributes
    ----------
    way_m
        Length of the localised way in metres.
    end_m, end_deg
        Distance and angle of the last poses.
    largest_m, rms_m
        Largest and root mean square distance of all key poses.
    """

    way_m: float
    end_m: float
    end_deg: float
    largest_m: float
    rms_m: float

    @property
    def end_share(self) -> float:
        """Distance of the last poses as a share of the way."""
        return self.end_m / self.way_m if self.way_m > 0 else 0.0


@dataclass(frozen=True)
class SensorUse(Record):
    """What a sensor's readings were worth.

    Attributes
    ----------
    sensor
        Name.
    readings, outside_map, rejected
        How many were on key poses, how many of them the map has no data for, and how many more it
        does not explain.
    rms
        Of a component of the residuals of the others in uT.
    chi2_per_dof
        Mean square of their whitened components; 1 is consistent, and a little less is left by the
        fit.
    """

    sensor: str
    readings: int
    outside_map: int
    rejected: int
    rms: float
    chi2_per_dof: float

    @property
    def used(self) -> int:
        """How many counted."""
        return self.readings - self.outside_map - self.rejected


@dataclass(frozen=True)
class LocalisationResult:
    """A drive localised in a magnetic map.

    Attributes
    ----------
    status, message
        How it ended, and a sentence about it.
    trajectory
        Key poses in the map, with the covariance of each.
    odometry
        Where odometry alone would have them, from where the drive is said to begin.
    drift
        The difference of both in figures.
    sensors
        What each sensor's readings were worth.
    calibration
        The sensors' calibration as it came out; absent where it was fixed.
    notes
        What is worth a warning, a sentence each.
    bag, map, calibration_source
        Sources with hashes; absent when the data did not come from files.
    """

    status: LocalisationStatus
    message: str
    trajectory: Trajectory
    odometry: Trajectory
    drift: DriftFigures
    sensors: tuple[SensorUse, ...]
    calibration: CalibrationResult | None
    notes: tuple[str, ...]
    bag: SourceFile | None
    map: SourceFile | None
    calibration_source: SourceFile | None

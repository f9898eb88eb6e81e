"""What comes out of a localisation: frozen records, with shapes and units."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from l2m_gtsam.data import FloatArray, RigidTransform, SourceFile, Trajectory
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.record import Record


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
        Length of the localised path in metres.
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
        """Distance of the last poses as a share of the path's length."""
        return self.end_m / self.way_m if self.way_m > 0 else 0.0


@dataclass(frozen=True)
class OdometryScale(Record):
    """What odometry's scale came out as.

    Attributes
    ----------
    longer
        Share by which all distances are longer than odometry has them; negative: shorter.
    sigma
        Its standard deviation.
    """

    longer: float
    sigma: float


@dataclass(frozen=True)
class OdometryTurn(Record):
    """What odometry's steady turning came out as.

    Attributes
    ----------
    left_deg_per_m
        By how much odometry turns too far to the left, degrees per metre in the drive's mean;
        negative: to the right.
    sigma
        Its standard deviation.
    """

    left_deg_per_m: float
    sigma: float


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
class ScanUse(Record):
    """What a LiDAR's scans were worth beside odometry.

    Attributes
    ----------
    fixes, loops
        How many poses in the map, and returns to earlier places, counted.
    rejected
        How many more were not believed: they do not fit odometry and the others.
    chi2_per_dof
        Mean square of the whitened components by which the poses differ from them; 1 is consistent.
    """

    fixes: int
    loops: int
    rejected: int
    chi2_per_dof: float


class StartVerdict(StrEnum):
    """What a search for the start of a drive came to."""

    UNIQUE = "unique"
    AMBIGUOUS = "ambiguous"
    NOT_HERE = "not_here"


@dataclass(frozen=True)
class StartCandidate:
    """A place where a drive may have begun.

    Attributes
    ----------
    T_map_lidar
        First key pose.
    covariance
        Of a right perturbation of it, rotation (rad) before translation (m), shape (6, 6).
    log_likelihood
        Of the readings looked at.
    inside
        Share of them that the map has data for.
    explained
        Share of those that fit.
    chi2_per_dof
        Mean square of what they leave, in sigmas; 1 is consistent.
    """

    T_map_lidar: RigidTransform
    covariance: FloatArray
    log_likelihood: float
    inside: float
    explained: float
    chi2_per_dof: float

    @property
    def yaw_deg(self) -> float:
        """Heading of the lidar's x axis in the map in degrees."""
        R = self.T_map_lidar.R
        return float(np.rad2deg(np.arctan2(R[1, 0], R[0, 0])))


@dataclass(frozen=True)
class StartFinding(Record):
    """What a search for the start of a drive, over the whole map, resulted in.

    Attributes
    ----------
    verdict, message
        What was found, and a sentence about it.
    margin
        Log likelihood ratio of the first candidate and the second, tempered where the first leaves
        more than noise. Without a second it is infinite, and NaN in a file.
    window_m, readings
        Length of the path that was searched in the end, metres, and number of readings on it.
    looked_at
        Places and headings of the lattice.
    """

    verdict: StartVerdict
    message: str
    margin: float
    window_m: float
    readings: int
    looked_at: int


@dataclass(frozen=True)
class StartSearch(StartFinding):
    """The finding with its candidates: places that are apart, the likeliest first."""

    candidates: tuple[StartCandidate, ...]


@dataclass(frozen=True)
class Explored(Record):
    """What became of a place without a map.

    Attributes
    ----------
    tiles
        That its field was laid out on.
    returned
        Share of the key poses in tiles that had been left before: loops are closed there.
    """

    tiles: int
    returned: float


@dataclass(frozen=True)
class Gain(Record):
    """What a correction of odometry's poses is worth, without a truth.

    Attributes
    ----------
    likelier
        Logarithm of how much likelier the corrected poses are than odometry's: by the readings,
        less what these poses cost against odometry and by how much readings narrow them.
    moved_m
        Root mean square distance of the corrected positions from odometry's, metres.
    doubt
        Probability that odometry's positions are nearer to the true ones, by the sigmas.
    shown
        Whether the correction is kept; if not, poses are odometry's with their sigmas.
    """

    likelier: float
    moved_m: float
    doubt: float
    shown: bool

    @property
    def reason(self) -> str:
        """The figures as a clause."""
        change = "likelier" if self.likelier > 0 else "less likely"
        return (
            f"poses that the readings correct by {self.moved_m:.2g} m rms are {change} than "
            f"odometry's by exp({abs(self.likelier):.0f}), and further from the truth with a "
            f"probability of {self.doubt:.2g}"
        )


@dataclass(frozen=True)
class LocalisationResult:
    """A drive localised in a magnetic map, or in the field that it met.

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
    start
        How the start was found; absent where it was known.
    explored
        How the field was found; absent where there was a map.
    scans
        What scans were worth; absent without any.
    by_scans
        Key poses by odometry and scans, without magnetometers; absent without scans.
    scale
        Of odometry; absent where it counts as right.
    gain
        What the correction of odometry is worth; absent where there was a map.
    hints
        What options would make poses better, a sentence each.
    """

    status: LocalisationStatus
    message: str
    trajectory: Trajectory
    odometry: Trajectory
    drift: DriftFigures
    sensors: tuple[SensorUse, ...]
    calibration: CalibrationResult | None
    notes: tuple[str, ...]
    bag: SourceFile | None = None
    map: SourceFile | None = None
    calibration_source: SourceFile | None = None
    start: StartSearch | None = None
    explored: Explored | None = None
    scans: ScanUse | None = None
    by_scans: Trajectory | None = None
    scale: OdometryScale | None = None
    turn: OdometryTurn | None = None
    gain: Gain | None = None
    hints: tuple[str, ...] = ()

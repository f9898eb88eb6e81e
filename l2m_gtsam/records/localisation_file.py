"""A localisation as plain numbers: frozen records, which `slam.json` holds.

Positions are in metres, fields in microtesla, angles in degrees, times in seconds, but for
covariances, which are in rad and m. A number that does not exist is NaN.
"""

from dataclasses import dataclass
from typing import Annotated, Any

from l2m_gtsam.records.localisation import (
    DriftFigures,
    Explored,
    Gain,
    LocalisationStatus,
    OdometryScale,
    OdometryTurn,
    ScanUse,
    SensorUse,
    StartFinding,
)
from l2m_gtsam.records.metrics import FitFigures, MapPicture, Normalised, Series
from l2m_gtsam.records.provenance import NamedSource
from l2m_gtsam.records.record import Record, Row, Rows, Shape
from l2m_gtsam.records.validation import ChiSquare
from l2m_gtsam.records.verdict import Judgement

POSE_FREEDOM = 6


@dataclass(frozen=True)
class PoseRecord(Record):
    """T_map_lidar at a key pose.

    Attributes
    ----------
    stamp_ns
        When, in nanoseconds.
    p, quaternion_xyzw
        Position and rotation.
    covariance
        Of a right perturbation, ``T_true = T_map_lidar Exp(error)``: rotation (rad), then
        translation (m), along the axes of the lidar, (6, 6); absent where it is unknown.
    """

    stamp_ns: int
    p: Annotated[Row, Shape("3")]
    quaternion_xyzw: Annotated[Row, Shape("4")]
    covariance: Annotated[Rows | None, Shape("6 6")]


@dataclass(frozen=True)
class OdometryRecord(Record):
    """Where odometry alone has the lidar at a key pose, from where the drive is said to begin.

    Attributes
    ----------
    p, quaternion_xyzw
        Position and rotation.
    sigma
        How sure it is by then: along x, y, z of the map in m, and about them in degrees.
    """

    p: Annotated[Row, Shape("3")]
    quaternion_xyzw: Annotated[Row, Shape("4")]
    sigma: Annotated[Row, Shape("6")]


@dataclass(frozen=True)
class Timeline(Record):
    """How many readings of a sensor counted in each of N spans of time.

    Attributes
    ----------
    edges
        Of the spans, since the first key pose, N + 1.
    used, rejected, outside
        That counted, that the map does not explain, that it has no data for.
    """

    edges: Annotated[Row, Shape("N+1")]
    used: Annotated[tuple[int, ...], Shape("N")]
    rejected: Annotated[tuple[int, ...], Shape("N")]
    outside: Annotated[tuple[int, ...], Shape("N")]


@dataclass(frozen=True)
class SensorRecord(Record):
    """One sensor.

    Attributes
    ----------
    use
        What its readings were worth.
    timeline
        When they counted.
    fit, normalised, series
        How they fit, and their course, in which each has the time of its key pose; absent where
        none counts.
    """

    use: SensorUse
    timeline: Timeline
    fit: FitFigures | None
    normalised: Normalised | None
    series: Series | None


@dataclass(frozen=True)
class RefinedSensor(Record):
    """A calibration before and after a drive: t in m, C row by row, H in uT, 15 numbers.

    Attributes
    ----------
    sensor
        Name.
    before, sigma_before, after, sigma_after
        With standard deviations.
    change
        Squared length of the change in units of the covariance before, beside what chance makes
        of it: at most this if that covariance was true.
    """

    sensor: str
    before: Annotated[Row, Shape("15")]
    sigma_before: Annotated[Row, Shape("15")]
    after: Annotated[Row, Shape("15")]
    sigma_after: Annotated[Row, Shape("15")]
    change: ChiSquare


@dataclass(frozen=True)
class PoseErrors(Record):
    """Distance and angle of poses to the truth: root mean squares and the largest."""

    rms_m: float
    largest_m: float
    rms_deg: float
    largest_deg: float


@dataclass(frozen=True)
class TruthRecord(Record):
    """A localisation beside the truth, at the key poses that have one.

    Attributes
    ----------
    poses
        How many.
    odometry, localised
        Errors of both; nothing is aligned.
    by_scans
        Errors of odometry and scans without magnetometers; absent without scans.
    nees
        Mean of the squared errors of localised poses in units of their covariances; expected 6.
        Without a first pose that defines the frame.
    beyond_95
        Share of those beyond the 95 % quantile of chi-square of six; expected 0.05.
    path
        True places at all K key poses, (K, 3); NaN where there is none.
    odometry_m, localised_m, squared
        Distances, and squared errors in units of their covariances, K of each; NaN there, too, and
        of a first pose that defines the frame.
    """

    poses: int
    odometry: PoseErrors
    localised: PoseErrors
    by_scans: PoseErrors | None
    nees: float
    beyond_95: float
    path: Annotated[Rows, Shape("N 3")]
    odometry_m: Annotated[Row, Shape("N")]
    localised_m: Annotated[Row, Shape("N")]
    squared: Annotated[Row, Shape("N")]

    @property
    def removed(self) -> float:
        """Share of odometry's error that is gone, of root mean squares; negative if it grew."""
        before = self.odometry.rms_m
        return 1 - self.localised.rms_m / before if before > 0 else float("nan")

    @property
    def nees_ratio(self) -> float:
        """NEES per degree of freedom; 1 is consistent."""
        return self.nees / POSE_FREEDOM


@dataclass(frozen=True)
class StartCandidateRecord(Record):
    """A place where a drive may have begun; see ``StartCandidate``.

    Attributes
    ----------
    p, quaternion_xyzw
        Position and rotation of the first key pose.
    covariance
        Of a right perturbation of it, rotation (rad), then translation (m), (6, 6).
    log_likelihood, inside, explained, chi2_per_dof
        Of the readings looked at, and how they fit.
    """

    p: Annotated[Row, Shape("3")]
    quaternion_xyzw: Annotated[Row, Shape("4")]
    covariance: Annotated[Rows, Shape("6 6")]
    log_likelihood: float
    inside: float
    explained: float
    chi2_per_dof: float


@dataclass(frozen=True)
class StartRecord(StartFinding):
    """The finding with its candidates, the likeliest first; see ``StartSearch``."""

    candidates: tuple[StartCandidateRecord, ...]


@dataclass(frozen=True)
class LocalisationRecord(Record):
    """All that a report on a localisation is made from.

    Attributes
    ----------
    status, message
        How it ended, and a sentence about it.
    notes
        What is worth a warning, a sentence each.
    drift
        Odometry alone less the localised poses.
    steps
        Mean square of the whitened components by which the steps between localised poses differ
        from odometry's; 1 is consistent.
    scale
        Of odometry; absent where it counts as right.
    map_errors_shared
        Whether the map says how its errors at two places go together.
    sensors
        In the order of the drive.
    refined
        Calibrations before and after; empty where they were fixed.
    poses, odometry
        At key poses.
    start
        Where it was looked for; absent where it was given.
    explored
        How the field was found; absent where there was a map.
    scans
        What a LiDAR's scans were worth; absent without any.
    truth
        Absent where none was given.
    picture
        The map around the drive.
    sources
        Files that took part.
    versions
        Of the packages that computed it.
    options
        That it was computed with.
    judgement
        The verdict with its thresholds; files of older versions have none.
    gain
        What the correction of odometry is worth; absent where there was a map, and in files of
        older versions.
    hints
        What options would make poses better, a sentence each; none in files of older versions.
    turn
        Odometry's steady turning; absent where it was not estimated, and in files of older
        versions.
    """

    status: LocalisationStatus
    message: str
    notes: tuple[str, ...]
    drift: DriftFigures
    steps: float
    scale: OdometryScale | None
    map_errors_shared: bool
    sensors: tuple[SensorRecord, ...]
    refined: tuple[RefinedSensor, ...]
    poses: Annotated[tuple[PoseRecord, ...], Shape("K")]
    odometry: Annotated[tuple[OdometryRecord, ...], Shape("K")]
    start: StartRecord | None
    explored: Explored | None
    scans: ScanUse | None
    truth: Annotated[TruthRecord | None, Shape("K 3", of="path")]
    picture: MapPicture
    sources: tuple[NamedSource, ...]
    versions: dict[str, str]
    options: dict[str, Any]
    judgement: Judgement | None = None
    gain: Gain | None = None
    hints: tuple[str, ...] = ()
    turn: OdometryTurn | None = None

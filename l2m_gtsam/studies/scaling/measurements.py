"""How time and memory grow with readings, sensors, the survey's size and workers: options, records.

Each quantity is grown while the others stay as they are. Times are those of one core (processor
time), but for those of several workers.
"""

from dataclasses import dataclass
from enum import StrEnum

from pydantic import Field

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.options import Options
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import ArrayOptions, NoiseOptions, SamplingOptions, SuiteOptions
from l2m_gtsam.studies.site import SiteOptions


class Part(StrEnum):
    """A quantity that is grown; its value is what page and figures call it."""

    READINGS = "readings"
    SENSORS = "sensors"
    SURVEY = "survey"
    WORKERS = "workers"


class Way(StrEnum):
    """What is timed."""

    POINT = "ours, values"
    FULL = "ours, with uncertainty"
    NUMERIC = "numeric least squares"
    HARMONIC = "harmonic map"
    SLIDING = "sliding GP"
    DENSE = "dense GP"
    BATCH = "batch"
    STARTED = "batch, with start of the workers"


class ScalingOptions(Options):
    """Sizes that are measured; lengths in metres."""

    seed: int = Field(default=1, ge=0)
    """Of drives and sensors; the sites have their own."""
    readings: tuple[int, ...] = (250, 500, 1000, 2000, 4000, 8000, 16000)
    """Of one sensor."""
    numeric_readings: int = Field(default=4000, ge=0)
    """The peer gets no more."""
    sensors: tuple[int, ...] = (1, 2, 3, 4, 6, 9, 12)
    """That are calibrated together."""
    each: int = Field(default=500, ge=30)
    """Readings of each of them."""
    numeric_sensors: int = Field(default=4, ge=0)
    """The peer gets no more."""
    survey: tuple[int, ...] = (1000, 2000, 4000, 8000, 16000, 32000)
    """Readings of which maps are made: those next to the middle of the hall, so that the mapped
    floor grows and the density stays."""
    dense: tuple[int, ...] = (500, 1000, 2000, 4000)
    """Readings of which the peer makes maps: one Gaussian process of all of them."""
    workers: tuple[int, ...] = (1, 2, 4)
    """Local processes that share a batch of calibrations."""
    calibrations: int = Field(default=24, ge=1)
    """In the batch."""
    rounds: int = Field(default=2, ge=1)
    """Each time is the least of so many, but for those that take long and those of workers."""
    long: float = Field(default=5.0, gt=0)
    """What takes so many seconds is timed once."""
    around: float = Field(default=2.5, gt=0)
    """The map of readings and sensors is made of the survey within so many metres of the drive."""
    rate: float = Field(default=200.0, gt=0)
    """Readings per second on the drive, of which the wanted number is taken, evenly."""
    site: SiteOptions = SiteOptions(
        scenario=ScenarioOptions(
            noise=NoiseOptions(field=0.2),
            calibration_sampling=SamplingOptions(field_rate=10.0),
        ),
        sync=SyncOptions(thin_distance_m=0.0, thin_angle_deg=0.0),
    )
    """World and survey; its array's first sensors are those that are calibrated."""
    small_site: SiteOptions = SiteOptions(
        scenario=ScenarioOptions(
            floor_plan=FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
            suite=SuiteOptions(lateral=(0.0,)),
            array=ArrayOptions(count=1),
            noise=NoiseOptions(field=0.2),
            calibration_route=CalibrationRouteOptions(turns=1),
            calibration_sampling=SamplingOptions(field_rate=20.0),
        )
    )
    """Where workers calibrate: each number of them makes its map anew."""
    search: StartOptions = StartOptions()
    """How starts are looked for."""
    solve: OneKeyOptions = OneKeyOptions()
    """How calibrations are solved, but for how they count the map's errors."""


@dataclass(frozen=True)
class Measurement:
    """One point of a curve.

    Attributes
    ----------
    part
        The quantity that is grown.
    way
        What is timed.
    size
        The quantity: readings, sensors, readings of the survey, or workers.
    seconds
        That it took.
    peak_mib
        By how much memory grew meanwhile, at most; absent where it is not known.
    """

    part: Part
    way: Way
    size: int
    seconds: float
    peak_mib: float | None = None


@dataclass(frozen=True)
class ScalingCell:
    """What was measured at one size."""

    measurements: tuple[Measurement, ...]

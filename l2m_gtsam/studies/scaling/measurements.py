"""How time and memory grow with readings, sensors, the survey's size and workers: options, records.

Each quantity is grown while the others stay as they are. Times are those of one core (processor
time), but for those of several workers.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.options import Options
from l2m_gtsam.recording.sync import SyncOptions
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.route import CalibrationRouteOptions
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import (
    MappingSuiteOptions,
    NoiseOptions,
    SamplingOptions,
    SensorArrayOptions,
)
from l2m_gtsam.studies.site import SiteOptions


class Quantity(StrEnum):
    """A quantity that is grown; its value is what page and figures call it."""

    READINGS = "readings"
    SENSORS = "sensors"
    SURVEY = "survey"
    WORKERS = "workers"


class TimedTask(StrEnum):
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
            noise=NoiseOptions(field=0.2), calibration_sampling=SamplingOptions(field_rate=10.0)
        ),
        sync=SyncOptions(thin_distance_m=0.0, thin_angle_deg=0.0),
    )
    """World and survey; its array's first sensors are those that are calibrated."""
    small_site: SiteOptions = SiteOptions(
        scenario=ScenarioOptions(
            floor_plan=FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
            suite=MappingSuiteOptions(lateral=(0.0,)),
            array=SensorArrayOptions(count=1),
            noise=NoiseOptions(field=0.2),
            calibration_route=CalibrationRouteOptions(turns=1),
            calibration_sampling=SamplingOptions(field_rate=20.0),
        )
    )
    """Where workers calibrate: each number of them makes its map anew."""
    search: StartOptions = StartOptions()
    """Search for starts."""
    solve: OneKeyOptions = OneKeyOptions()
    """How calibrations are solved, but for how they count the map's errors."""


@dataclass(frozen=True)
class Measurement:
    """One point of a curve.

    Attributes
    ----------
    size
        The quantity: readings, sensors, readings of the survey, or workers.
    seconds
        That it took.
    peak_mib
        By how much memory grew meanwhile, at most; absent where it is not known.
    """

    part: Quantity
    way: TimedTask
    size: int
    seconds: float
    peak_mib: float | None = None


@dataclass(frozen=True)
class ScalingCell:
    """What was measured at one size."""

    measurements: tuple[Measurement, ...]


STEEP = 3  # the largest sizes, of which the exponent is taken: small ones cost what is fixed


@dataclass(frozen=True)
class Curve:
    """How time grows with one quantity.

    Attributes
    ----------
    points
        From the smallest size to the largest.
    exponent
        Slope of log time over log size through the largest sizes; absent for a single size.
    """

    part: Quantity
    way: TimedTask
    points: tuple[Measurement, ...]
    exponent: float | None


@dataclass(frozen=True)
class Ratio:
    """How many times as long the peer takes as what it is compared with.

    Attributes
    ----------
    size
        The largest that both were measured at.
    """

    part: Quantity
    way: TimedTask
    peer: TimedTask
    size: int
    times: float


@dataclass(frozen=True)
class Speed:
    """What several workers gain.

    Attributes
    ----------
    times
        The time of one worker over theirs, for computing alone.
    started
        The same with the start of the workers and what they prepare.
    """

    workers: int
    times: float
    started: float


@dataclass(frozen=True)
class ScalingTable:
    """The study's outcome."""

    options: ScalingOptions
    curves: tuple[Curve, ...]
    ratios: tuple[Ratio, ...]
    speeds: tuple[Speed, ...]


PEERS = {
    Quantity.READINGS: TimedTask.NUMERIC,
    Quantity.SENSORS: TimedTask.NUMERIC,
    Quantity.SURVEY: TimedTask.DENSE,
}


def scaling_table(options: ScalingOptions, measured: Iterable[Measurement]) -> ScalingTable:
    """Return curves, ratios and speeds of all measurements."""
    points = sorted(measured, key=lambda each: each.size)
    curves = []
    for part in Quantity:
        for task in TimedTask:
            own = tuple(each for each in points if (each.part, each.way) == (part, task))
            if own:
                curves.append(Curve(part, task, own, exponent(own)))
    found = [ratio(curve, peer_of(curves, curve.part)) for curve in curves]
    return ScalingTable(
        options, tuple(curves), tuple(each for each in found if each is not None), speeds(curves)
    )


def exponent(points: tuple[Measurement, ...]) -> float | None:
    """Return how steep the largest of some points, in order of size, lie in logarithms."""
    last = points[-STEEP:]
    if len({each.size for each in last}) < 2:
        return None
    # t = a n^k is a line of slope k in logarithms.
    size, seconds = np.log([[each.size, each.seconds] for each in last]).T
    return float(np.polyfit(size, seconds, 1)[0])


def peer_of(curves: Iterable[Curve], part: Quantity) -> Curve | None:
    """Return the peer's curve for a quantity, if there is one."""
    wanted = (part, PEERS.get(part))
    return next((each for each in curves if (each.part, each.way) == wanted), None)


def ratio(curve: Curve, peer: Curve | None) -> Ratio | None:
    """Return how much longer the peer takes; nothing for the peer itself and without a peer."""
    if peer is None or curve.way is peer.way:
        return None
    ours = {each.size: each.seconds for each in curve.points}
    both = [each for each in peer.points if each.size in ours]
    if not both:
        return None
    last = both[-1]
    return Ratio(curve.part, curve.way, peer.way, last.size, last.seconds / ours[last.size])


def speeds(curves: Iterable[Curve]) -> tuple[Speed, ...]:
    """Return what each number of workers gains over the fewest."""
    of = {each.way: each.points for each in curves if each.part is Quantity.WORKERS}
    alone, started = of.get(TimedTask.BATCH, ()), of.get(TimedTask.STARTED, ())
    return tuple(
        Speed(a.size, alone[0].seconds / a.seconds, started[0].seconds / s.seconds)
        for a, s in zip(alone, started, strict=True)
    )

"""The measurements of the scaling study within one process."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import process_time

import numpy as np

from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.start.global_start import find_starts
from l2m_gtsam.calibration.view import QueryableMap, spread
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.maps.training import ThinningOptions, TrainingSet
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.simulate.sensors import random_array
from l2m_gtsam.studies.measured import MeasuredWork, measured
from l2m_gtsam.studies.methods import numeric_least_squares
from l2m_gtsam.studies.scaling.measurements import Measurement, Quantity, ScalingOptions, TimedTask
from l2m_gtsam.studies.site import SurveyedSite, around, readings_of

KINDS = {
    TimedTask.HARMONIC: "harmonic",
    TimedTask.SLIDING: "sliding_gp",
    TimedTask.DENSE: "dense_gp",
}
WARM = 200  # readings that pass everywhere on the drive
SENSORS, ROUTE = 1, 2  # streams of randomness


@dataclass(frozen=True)
class MappedDrive:
    """A map and a drive through it.

    Attributes
    ----------
    readings
        Of all sensors.
    t_true
        Their places in the lidar frame in metres, shape (S, 3).
    """

    field_map: QueryableMap
    readings: Readings
    t_true: FloatArray

    def first(self, sensors: int) -> "MappedDrive":
        """Return the drive with the first sensors only."""
        keep = self.readings.select(self.readings.sensor < sensors)
        readings = replace(keep, sensors=keep.sensors[:sensors])
        return replace(self, readings=readings, t_true=self.t_true[:sensors])

    def thinned(self, most: int) -> "MappedDrive":
        """Return the drive with so many readings of each sensor."""
        return replace(self, readings=self.readings.select(spread(self.readings, most)))


def mapped_drive(
    options: ScalingOptions, site: SurveyedSite, sensors: int, rate: float
) -> MappedDrive:
    """Return a drive with the first sensors of the site's array, and the map around it.

    Parameters
    ----------
    rate
        Readings of each per second.
    """
    scenario = options.site.scenario
    known = random_array(scenario.array, np.random.default_rng([options.seed, SENSORS]))[:sensors]
    sampling = scenario.calibration_sampling.model_copy(update={"field_rate": rate})
    sampled = scenario.model_copy(update={"calibration_sampling": sampling})
    chosen = options.site.model_copy(update={"scenario": sampled})
    readings = readings_of(site, chosen, known, np.random.default_rng([options.seed, ROUTE]))
    part = around(site, readings.p_map_lidar, options.around)
    t_true = np.array([sensor.t_lidar_mag for sensor in known])
    return MappedDrive(part.map(options.site.mapping.model), readings, t_true)


def warmed(options: ScalingOptions, work: MappedDrive) -> MappedDrive:
    """Return a drive on whose map something was calibrated before.

    A map prepares tiles at their first query, which may take longer than the rest;
    compiled functions are loaded.
    """
    for uncertainty in Uncertainty:
        solved(options, work.thinned(WARM), uncertainty)
    return work


def measured_solves(
    options: ScalingOptions, part: Quantity, size: int, work: MappedDrive, numeric: bool
) -> tuple[Measurement, ...]:
    """Time our method, without and with the map's shared errors, and the peer where wanted."""
    tasks: dict[TimedTask, Callable[[], object]] = {
        TimedTask.POINT: lambda: solved(options, work, Uncertainty.INDEPENDENT),
        TimedTask.FULL: lambda: solved(options, work, Uncertainty.FULL),
    }
    if numeric:
        tasks[TimedTask.NUMERIC] = lambda: numeric_least_squares(
            work.readings, lambda x: work.field_map.field_and_gradient(x)[0], work.t_true
        )
    took = {task: taken(call, options.rounds, options.long) for task, call in tasks.items()}
    return tuple(
        Measurement(part, w, size, each.seconds, each.peak_mib) for w, each in took.items()
    )


def solved(options: ScalingOptions, work: MappedDrive, uncertainty: Uncertainty) -> OneKeySolution:
    """Look for starts about the lidar and solve from there, as a calibration does."""
    found = find_starts(work.readings, work.field_map, np.zeros(3), options.search)
    starts = [start.t_lidar_mag for start in found if start is not None]
    chosen = options.solve.model_copy(update={"uncertainty": uncertainty})
    return solve_one_key(work.readings, work.field_map, np.array(starts), chosen)


def measured_map(
    options: ScalingOptions, task: TimedTask, size: int, site: SurveyedSite
) -> Measurement:
    """Time how a map is made of the readings next to the middle of the hall."""
    part = replace(site, survey=middle(site.survey, size))
    chosen = map_options(options.site.mapping.model, task)
    took = taken(lambda: part.map(chosen), options.rounds, options.long)
    return Measurement(Quantity.SURVEY, task, len(part.survey), took.seconds, took.peak_mib)


def map_options(base: MapOptions, task: TimedTask) -> MapOptions:
    """Return the options of a kind of map; the dense process gets every reading."""
    dense = base.dense_gp.model_copy(update={"thinning": ThinningOptions(spacing=0.0)})
    return base.model_copy(update={"kind": KINDS[task], "dense_gp": dense})


def middle(survey: TrainingSet, most: int) -> TrainingSet:
    """Return so many readings of a survey, those in the smallest square about its middle."""
    places = survey.points[:, :2]
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    away = np.abs(places - centre).max(axis=1)
    return survey[np.sort(np.argsort(away, kind="stable")[:most])]


def taken(work: Callable[[], object], rounds: int, long: float) -> MeasuredWork[None]:
    """Return the least time of some rounds, and the peak of memory in the first.

    Parameters
    ----------
    rounds
        How often at most.
    long
        Work that takes so many seconds is not repeated.
    """
    first = measured(work).of(None)
    seconds = first.seconds
    for _ in range(rounds - 1):
        if seconds >= long:
            break
        seconds = min(seconds, timed(work))
    return replace(first, seconds=seconds)


def timed(work: Callable[[], object]) -> float:
    """Return the processor time of a piece of work in seconds."""
    start = process_time()
    work()
    return process_time() - start

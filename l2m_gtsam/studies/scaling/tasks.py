"""The measurements of the scaling study within one process."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.alternation import spread
from l2m_gtsam.calibration.one_key import OneKeySolution, solve_one_key
from l2m_gtsam.calibration.start.global_start import find_starts
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.maps.training import ThinningOptions, TrainingSet
from l2m_gtsam.progress import silent
from l2m_gtsam.recording.sync import synchronise
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.simulate.drive import drive
from l2m_gtsam.simulate.recorder import Vehicle, record
from l2m_gtsam.simulate.route import calibration_route
from l2m_gtsam.simulate.sensors import random_array
from l2m_gtsam.studies.fingerprints import around
from l2m_gtsam.studies.scaling.measurements import Measurement, Part, ScalingOptions, Way
from l2m_gtsam.studies.scaling.numeric_peer import numeric_least_squares
from l2m_gtsam.studies.scaling.stopwatch import taken
from l2m_gtsam.studies.site import Surveyed

KINDS = {Way.HARMONIC: "harmonic", Way.SLIDING: "sliding_gp", Way.DENSE: "dense_gp"}
WARM = 200  # readings that pass everywhere on the drive
SENSORS, ROUTE = 1, 2  # streams of randomness


@dataclass(frozen=True)
class MappedDrive:
    """A map and a drive through it.

    Attributes
    ----------
    field_map
        The map.
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
        return replace(self, readings=spread(self.readings, most))


def mapped_drive(options: ScalingOptions, site: Surveyed, sensors: int, rate: float) -> MappedDrive:
    """Return a drive with the first sensors of the site's array, and the map around it.

    Parameters
    ----------
    options
        The study.
    site
        World and survey.
    sensors
        How many.
    rate
        Readings of each per second.
    """
    scenario = options.site.scenario
    known = random_array(scenario.array, np.random.default_rng([options.seed, SENSORS]))[:sensors]
    rng = np.random.default_rng([options.seed, ROUTE])
    route = calibration_route(scenario.calibration_route, site.plan)
    motion = drive(scenario.calibration_drive, route, 0, rng)
    sampling = scenario.calibration_sampling.model_copy(update={"field_rate": rate})
    vehicle = Vehicle("calibration", known, motion, sampling, scenario.noise)
    simulated = record(vehicle, site.world, rng, silent)
    readings = synchronise(simulated.recording, options.site.sync).readings
    part = around(site, readings.p_map_lidar, options.around)
    t_true = np.array([sensor.t_lidar_mag for sensor in known])
    return MappedDrive(part.map(options.site.mapping.model), readings, t_true)


def warmed(options: ScalingOptions, work: MappedDrive) -> MappedDrive:
    """Return a drive on whose map something was calibrated before.

    A map makes ready what it is asked for the first time, which may take longer than the rest;
    compiled functions are loaded.
    """
    for uncertainty in Uncertainty:
        solved(options, work.thinned(WARM), uncertainty)
    return work


def measured_solves(
    options: ScalingOptions, part: Part, size: int, work: MappedDrive, numeric: bool
) -> tuple[Measurement, ...]:
    """Time our method, without and with the map's shared errors, and the peer where wanted."""
    tasks: dict[Way, Callable[[], object]] = {
        Way.POINT: lambda: solved(options, work, Uncertainty.INDEPENDENT),
        Way.FULL: lambda: solved(options, work, Uncertainty.FULL),
    }
    if numeric:
        tasks[Way.NUMERIC] = lambda: numeric_least_squares(
            work.readings, work.field_map, work.t_true
        )
    took = {way: taken(task, options.rounds, options.long) for way, task in tasks.items()}
    return tuple(
        Measurement(part, w, size, each.seconds, each.peak_mib) for w, each in took.items()
    )


def solved(options: ScalingOptions, work: MappedDrive, uncertainty: Uncertainty) -> OneKeySolution:
    """Look for starts about the lidar and solve from there, as a calibration does."""
    found = find_starts(work.readings, work.field_map, np.zeros(3), options.search)
    starts = [start.t_lidar_mag for start in found if start is not None]
    chosen = options.solve.model_copy(update={"uncertainty": uncertainty})
    return solve_one_key(work.readings, work.field_map, np.array(starts), chosen)


def measured_map(options: ScalingOptions, way: Way, size: int, site: Surveyed) -> Measurement:
    """Time how a map is made of the readings next to the middle of the hall."""
    part = replace(site, survey=middle(site.survey, size))
    chosen = map_options(options.site.mapping.model, way)
    took = taken(lambda: part.map(chosen), options.rounds, options.long)
    return Measurement(Part.SURVEY, way, len(part.survey), took.seconds, took.peak_mib)


def map_options(base: MapOptions, way: Way) -> MapOptions:
    """Return the options of a kind of map; the dense process gets every reading."""
    dense = base.dense_gp.model_copy(update={"thinning": ThinningOptions(spacing=0.0)})
    return base.model_copy(update={"kind": KINDS[way], "dense_gp": dense})


def middle(survey: TrainingSet, most: int) -> TrainingSet:
    """Return so many readings of a survey, those in the smallest square about its middle."""
    places = survey.points[:, :2]
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    away = np.abs(places - centre).max(axis=1)
    return survey[np.sort(np.argsort(away, kind="stable")[:most])]

"""Where studies take place: a simulated warehouse with the map of its survey."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial import cKDTree

from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import BoolArray, FloatArray, IntArray, KnownSensor, Readings
from l2m_gtsam.mapping.map_building import suite_readings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.build import KINDS, MapOptions, build_map
from l2m_gtsam.maps.training import TrainingSet, checked_readings
from l2m_gtsam.options import Options
from l2m_gtsam.progress import silent
from l2m_gtsam.recording.sync import SyncOptions, synchronise
from l2m_gtsam.simulate.drive import drive
from l2m_gtsam.simulate.floor_plan import FloorPlan
from l2m_gtsam.simulate.recorder import Vehicle, record
from l2m_gtsam.simulate.route import calibration_route
from l2m_gtsam.simulate.scenario import ScenarioOptions, simulate
from l2m_gtsam.simulate.sensors import (
    NoiseOptions,
    SamplingOptions,
    SensorArrayOptions,
    random_distortion,
)
from l2m_gtsam.simulate.world import SteelWorld


class SiteOptions(Options):
    """A warehouse, its survey and map, and the drives whose sensors are calibrated."""

    scenario: ScenarioOptions = ScenarioOptions(
        array=SensorArrayOptions(count=1),
        noise=NoiseOptions(field=0.2),
        calibration_sampling=SamplingOptions(field_rate=10.0),
    )
    """The world of `l2m demo`, with the noise of the paper's study; of its calibration drive the
    route, noise and sampling count. Ten readings per second are about 1,000 on the drive: with a
    third of them noise alone leaves one sensor in twenty more than 2 cm off, from any start."""
    mapping: MappingOptions = MappingOptions()
    """How the map is made of the survey."""
    sync: SyncOptions = SyncOptions()
    """Which readings of a drive enter."""
    radius: float = Field(default=0.6, gt=0)
    """Sensors sit within so many metres of the lidar, at heights that the survey passed."""

    @model_validator(mode="after")
    def _heights_within_reach(self) -> Self:
        heights = self.scenario.suite.heights
        if min(heights) >= self.radius or max(heights) <= -self.radius:
            raise ValueError(
                f"scenario.suite.heights: none is less than the `radius` of {self.radius:g} m away"
            )
        return self


@dataclass(frozen=True)
class SurveyedSite:
    """A world and what a survey of it measured.

    Attributes
    ----------
    world, plan
        Steel, racks and aisles.
    survey
        Places and readings in the map frame.
    cloud
        What a LiDAR saw: points of the map frame in metres, shape (M, 3).
    """

    world: SteelWorld
    plan: FloorPlan
    survey: TrainingSet
    cloud: FloatArray

    def map(self, options: MapOptions) -> QueryableMap:
        """Return a map of the survey, in its form for solvers."""
        cloud = self.cloud if KINDS[options.kind].uses_structure else None
        learnt = build_map(self.survey.points, self.survey.field, options, cloud)
        return for_solvers(learnt)


@dataclass(frozen=True)
class Site:
    """A world and the map that a survey of it gave."""

    world: SteelWorld
    plan: FloorPlan
    field_map: QueryableMap


@dataclass(frozen=True)
class SiteDrive:
    """The readings of one sensor on a drive, and the truth about it."""

    sensor: KnownSensor
    readings: Readings


def surveyed(options: SiteOptions) -> SurveyedSite:
    """Return the site and its survey."""
    scenario = simulate(options.scenario)
    suite = {sensor.sensor: sensor for sensor in scenario.suite}
    read = suite_readings([scenario.mapping.recording], suite, options.mapping.sync)
    survey = checked_readings(read.points, read.field)
    return SurveyedSite(scenario.world, scenario.plan, survey, scenario.cloud)


@lru_cache(maxsize=1)
def mapped_site(options: SiteOptions) -> Site:
    """Return the site with its map; made once in each process."""
    site = surveyed(options)
    return Site(site.world, site.plan, site.map(options.mapping.model))


def random_drive(
    site: Site | SurveyedSite, options: SiteOptions, rng: np.random.Generator
) -> SiteDrive:
    """Return a drive through the site with a sensor of random place and distortion."""
    place = random_place(options, rng)
    sensor = KnownSensor("mag", place, random_distortion(options.scenario.array, rng))
    return SiteDrive(sensor, readings_of(site, options, (sensor,), rng))


def readings_of(
    site: Site | SurveyedSite,
    options: SiteOptions,
    sensors: tuple[KnownSensor, ...],
    rng: np.random.Generator,
) -> Readings:
    """Return what sensors read on a drive through the site."""
    scenario = options.scenario
    route = calibration_route(scenario.calibration_route, site.plan)
    motion = drive(scenario.calibration_drive, route, 0, rng)
    sampling = scenario.calibration_sampling
    vehicle = Vehicle("calibration", sensors, motion, sampling, scenario.noise)
    simulated = record(vehicle, site.world, rng, silent)
    return synchronise(simulated.recording, options.sync).readings


def random_place(options: SiteOptions, rng: np.random.Generator) -> FloatArray:
    """Return a place in the lidar frame in metres, shape (3,), uniform where sensors may sit."""
    low, high = np.full(3, -options.radius), np.full(3, options.radius)
    heights = options.scenario.suite.heights
    low[2], high[2] = max(low[2], min(heights)), min(high[2], max(heights))
    # Rejection from the enclosing box leaves the ball uniform.
    while True:
        place = rng.uniform(low, high)
        if np.linalg.norm(place) <= options.radius:
            return np.asarray(place)


LAYER = 0.2  # metres; less than the suite's sensors are apart in height, more than it heaves
CELL = 0.5  # metres; edge of the squares of which surveyed floor is counted


def around(site: SurveyedSite, path: FloatArray, distance: float) -> SurveyedSite:
    """Return the part of a site within a horizontal distance of a path.

    Parameters
    ----------
    path
        Places in the map frame in metres, shape (M, 3).
    """
    rows = np.flatnonzero(_near(site.survey.points, path, distance))
    cloud = site.cloud[_near(site.cloud, path, distance)]
    return replace(site, survey=site.survey[rows], cloud=cloud)


def thinned(site: SurveyedSite, spacing: float) -> SurveyedSite:
    """Return a site with fewer survey readings; see ``thinned_rows``."""
    return replace(site, survey=site.survey[thinned_rows(site.survey.points, spacing)])


def thinned_rows(points: FloatArray, spacing: float) -> IntArray:
    """Return the readings that are left if each cell of the floor keeps one at each height.

    Parameters
    ----------
    points
        Places of the readings in the map frame in metres, shape (N, 3).
    spacing
        Edge of the cells in metres, of which each keeps the reading next to its middle; 0 keeps
        all.

    Returns
    -------
    Rows, ascending, shape (M,).
    """
    if spacing == 0.0:
        return np.arange(len(points))
    cells = np.floor(points / [spacing, spacing, LAYER]).astype(np.int64)
    aside = points[:, :2] - (cells[:, :2] + 0.5) * spacing
    nearest_first = np.argsort(np.linalg.norm(aside, axis=1), kind="stable")
    _, first = np.unique(cells[nearest_first], axis=0, return_index=True)
    return np.sort(nearest_first[first])


def surveyed_floor(points: FloatArray) -> float:
    """Return the floor on which readings, shape (N, 3) in metres, were taken, square metres."""
    return float(len(np.unique(np.floor(points[:, :2] / CELL), axis=0)) * CELL**2)


def _near(points: FloatArray, path: FloatArray, distance: float) -> BoolArray:
    """Return which points, shape (N, 3), are within a horizontal distance of a path (M, 3)."""
    away, _ = cKDTree(path[:, :2]).query(points[:, :2])
    return np.asarray(away <= distance)

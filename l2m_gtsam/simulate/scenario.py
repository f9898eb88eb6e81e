"""A whole scenario: a world, a mapping drive and a calibration drive in it."""

import datetime as dt
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import ppigrf
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from l2m_gtsam.data import FloatArray, KnownSensor
from l2m_gtsam.options import Options
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.simulate.drive import DriveOptions, drive
from l2m_gtsam.simulate.floor_plan import FloorPlan, FloorPlanOptions
from l2m_gtsam.simulate.lidar import RayCaster, SimulatedScans, SpinningLidarOptions, scan_stamps
from l2m_gtsam.simulate.odometry import OdometryDriftOptions, drifting
from l2m_gtsam.simulate.place import CorridorOptions, RouteOptions, SimulatedPlace, corridor, hall
from l2m_gtsam.simulate.recorder import SimulatedDrive, Vehicle, record
from l2m_gtsam.simulate.route import CalibrationRouteOptions, MappingRouteOptions
from l2m_gtsam.simulate.sensors import (
    MappingSuiteOptions,
    NoiseOptions,
    SamplingOptions,
    SensorArrayOptions,
    mapping_suite,
    random_array,
)
from l2m_gtsam.simulate.solids import StructureCloudOptions, structure_cloud
from l2m_gtsam.simulate.warehouse import WarehouseOptions
from l2m_gtsam.simulate.world import SteelWorld

NANOSECONDS = 1_000_000_000
MAPPING_TIME = dt.time(8)
CALIBRATION_TIME = dt.time(10)
ON_REQUEST = ("corridor", "lidar", "odometry")
MICROTESLA_PER_NANOTESLA = 1e-3
METRES_PER_KILOMETRE = 1e3
# What the reference field's coefficients cover.
FIRST_DAY, LAST_DAY = dt.date(1900, 1, 1), dt.date(2029, 12, 31)


class EarthOptions(Options):
    """Location and date of the warehouse, and the orientation of its map."""

    latitude: Annotated[float, Field(ge=-90, le=90)] = 1.3483
    """Geodetic latitude in degrees, north positive. The default is in Singapore."""
    longitude: Annotated[float, Field(ge=-180, le=180)] = 103.6831
    """Longitude in degrees, east positive."""
    altitude: Annotated[float, Field(ge=-500, le=9000)] = 20.0
    """Height above the ellipsoid in metres."""
    date: Annotated[dt.date, Field(ge=FIRST_DAY, le=LAST_DAY)] = dt.date(2025, 6, 1)
    """Day of the drives; the reference field's coefficients cover 1900 to 2029."""
    x_axis_azimuth: float = 90.0
    """Direction of the map's x axis, in degrees clockwise from north; 90 is x east, y north."""


def earth_field(options: EarthOptions) -> FloatArray:
    """Return the Earth's field in the map frame (z up) in microtesla, shape (3,).

    The International Geomagnetic Reference Field (Alken et al., Earth Planets Space 73:49,
    2021) as computed by `ppigrf`, which gives nanotesla along east, north and up.
    """
    east, north, up = (
        float(np.squeeze(component)) * MICROTESLA_PER_NANOTESLA
        for component in ppigrf.igrf(
            options.longitude,
            options.latitude,
            options.altitude / METRES_PER_KILOMETRE,
            dt.datetime.combine(options.date, dt.time()),
        )
    )
    azimuth = np.deg2rad(options.x_axis_azimuth)
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    return np.array([east * sin + north * cos, north * sin - east * cos, up])


class ScenarioOptions(Options):
    """Everything that a simulation depends on."""

    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of all randomness."""
    survey_seed: Annotated[int, Field(ge=0)] | None = None
    """Seed of the mapping drive alone: another survey of the same hall; follows `seed` if not
    given."""
    floor_plan: FloorPlanOptions = FloorPlanOptions()
    """The hall and its racks."""
    warehouse: WarehouseOptions = WarehouseOptions()
    """The steel in the hall."""
    structure: StructureCloudOptions = StructureCloudOptions()
    """What a LiDAR sees of it."""
    earth: EarthOptions = EarthOptions()
    """The Earth's field."""
    suite: MappingSuiteOptions = MappingSuiteOptions()
    """The mapping vehicle's sensors."""
    array: SensorArrayOptions = SensorArrayOptions()
    """The sensors to be calibrated."""
    noise: NoiseOptions = NoiseOptions()
    """Noise of both drives."""
    mapping_route: MappingRouteOptions = MappingRouteOptions()
    """Where the mapping vehicle drives."""
    mapping_drive: DriveOptions = DriveOptions(speed=1.5, yaw_rate=1.5)
    """How the mapping vehicle drives."""
    mapping_sampling: SamplingOptions = SamplingOptions(field_rate=8.0)
    """When the mapping vehicle measures."""
    calibration_route: CalibrationRouteOptions = CalibrationRouteOptions()
    """Where the vehicle with the array drives."""
    calibration_drive: DriveOptions = DriveOptions()
    """How the vehicle with the array drives."""
    calibration_sampling: SamplingOptions = SamplingOptions()
    """When the vehicle with the array measures."""
    corridor: CorridorOptions | None = None
    """A corridor without a feature in place of the hall, if it is given (`{}` for its defaults);
    it is driven from end to end and back, `calibration_route.laps` times."""
    lidar: SpinningLidarOptions | None = None
    """Point clouds of both drives, if it is given (`{}` for its defaults)."""
    odometry: OdometryDriftOptions | None = None
    """Drift of the poses of the vehicle with the array, if it is given (`{}` for its defaults);
    the true poses are recorded beside them then."""

    @model_serializer(mode="wrap")
    def _as_asked(self, content: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what is only there when it is asked for."""
        entries: dict[str, Any] = content(self)
        return {k: v for k, v in entries.items() if v is not None or k not in ON_REQUEST}


@dataclass(frozen=True)
class Scenario:
    """A simulated world and what two vehicles measured in it.

    Attributes
    ----------
    options
        The options it was made from.
    world
        All steel and the Earth's field.
    cloud
        Points that a LiDAR sees of the steel, in the map frame in metres, shape (N, 3).
    mapping
        The drive of the mapping suite.
    suite
        The mapping suite's sensors: known and free of distortion.
    truth
        The array's sensors: what a calibration should find.
    """

    options: ScenarioOptions
    plan: FloorPlan
    world: SteelWorld
    cloud: FloatArray
    mapping: SimulatedDrive
    calibration: SimulatedDrive
    suite: tuple[KnownSensor, ...]
    truth: tuple[KnownSensor, ...]


def simulate(options: ScenarioOptions, progress: Progress = silent) -> Scenario:
    """Return a scenario; the same options give the same arrays, bit for bit.

    Parameters
    ----------
    progress
        Called with the share of each of the two drives that is done.

    Raises
    ------
    ConfigError
        A drive would take a sensor through steel, or point clouds are asked for and the libraries
        that cast rays are not installed.
    """
    # One stream per part: another array leaves the world and the mapping drive as they are.
    steel, array, mapping, calibration, cloud, mapping_scans, scans, slips = (
        np.random.default_rng(seed) for seed in np.random.SeedSequence(options.seed).spawn(8)
    )
    if options.survey_seed is not None:
        mapping = np.random.default_rng([options.seed, options.survey_seed])
        mapping_scans = np.random.default_rng([options.seed, options.survey_seed, 1])
    place = _place(options, steel)
    suite, truth = mapping_suite(options.suite), random_array(options.array, array)
    eye = None if options.lidar is None else RayCaster(place.solids)
    noise, day = options.noise, options.earth.date
    motion = drive(options.mapping_drive, place.mapping_route, _stamp(day, MAPPING_TIME), mapping)
    mapper = Vehicle("mapping", suite, motion, options.mapping_sampling, noise)
    mapped = record(mapper, place.world, mapping, progress)
    start_ns = _stamp(day, CALIBRATION_TIME)
    motion = drive(options.calibration_drive, place.calibration_route, start_ns, calibration)
    rover = Vehicle("calibration", truth, motion, options.calibration_sampling, noise)
    driven = record(rover, place.world, calibration, progress)
    return Scenario(
        options=options,
        plan=place.plan,
        world=place.world,
        cloud=structure_cloud(place.structure, options.structure, cloud),
        mapping=_scanned(mapped, options.lidar, eye, mapping_scans),
        calibration=_scanned(_slipped(driven, options, slips), options.lidar, eye, scans),
        suite=suite,
        truth=truth,
    )


def _place(options: ScenarioOptions, rng: np.random.Generator) -> SimulatedPlace:
    """Return where both vehicles drive."""
    routes = RouteOptions(options.mapping_route, options.calibration_route)
    earth = earth_field(options.earth)
    if options.corridor is None:
        return hall(options.floor_plan, options.warehouse, routes, earth, rng)
    return corridor(options.corridor, options.warehouse, routes, earth, rng)


def _slipped(
    driven: SimulatedDrive, options: ScenarioOptions, rng: np.random.Generator
) -> SimulatedDrive:
    """Return a drive with odometry that drifts, if that is asked for."""
    if options.odometry is None:
        return driven
    return driven.with_poses(drifting(driven.truth(), options.odometry, options.noise, rng))


def _scanned(
    driven: SimulatedDrive,
    options: SpinningLidarOptions | None,
    eye: RayCaster | None,
    rng: np.random.Generator,
) -> SimulatedDrive:
    """Return a drive with the scans of a LiDAR, if there is one."""
    if options is None or eye is None:
        return driven
    motion = driven.motion
    stamp_ns = motion.start_ns + scan_stamps(options, motion.duration, rng)
    seed = int(rng.integers(1 << 32))
    return replace(driven, scans=SimulatedScans(eye, options, motion.at, stamp_ns, seed))


def _stamp(day: dt.date, time: dt.time) -> int:
    """Return a time of day (UTC) in nanoseconds since 1970."""
    return int(dt.datetime.combine(day, time, tzinfo=dt.UTC).timestamp()) * NANOSECONDS

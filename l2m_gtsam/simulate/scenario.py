"""A whole scenario: a world, a mapping drive and a calibration drive in it."""

import datetime as dt
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, KnownSensor
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.drive import DriveOptions, drive
from l2m_gtsam.simulate.earth import EarthOptions, earth_field
from l2m_gtsam.simulate.floor_plan import FloorPlan, FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.recorder import Progress, SimulatedDrive, Vehicle, record
from l2m_gtsam.simulate.route import (
    CalibrationRouteOptions,
    MappingRouteOptions,
    calibration_route,
    mapping_route,
)
from l2m_gtsam.simulate.sensors import (
    ArrayOptions,
    NoiseOptions,
    SamplingOptions,
    SuiteOptions,
    mapping_suite,
    random_array,
)
from l2m_gtsam.simulate.structure import StructureOptions, structure_cloud
from l2m_gtsam.simulate.warehouse import WarehouseOptions, build_warehouse
from l2m_gtsam.simulate.world import SteelWorld

NANOSECONDS = 1_000_000_000
MAPPING_TIME = dt.time(8)
CALIBRATION_TIME = dt.time(10)


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
    structure: StructureOptions = StructureOptions()
    """What a LiDAR sees of it."""
    earth: EarthOptions = EarthOptions()
    """The Earth's field."""
    suite: SuiteOptions = SuiteOptions()
    """The mapping vehicle's sensors."""
    array: ArrayOptions = ArrayOptions()
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


@dataclass(frozen=True)
class Scenario:
    """A simulated world and what two vehicles measured in it.

    Attributes
    ----------
    options
        The options it was made from.
    plan
        Racks and aisles.
    world
        All steel and the Earth's field.
    cloud
        Points that a LiDAR sees of the steel, in the map frame in metres, shape (N, 3).
    mapping
        The drive of the mapping suite.
    calibration
        The drive of the array.
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


def simulate(options: ScenarioOptions, progress: Progress | None = None) -> Scenario:
    """Return a scenario; the same options give the same arrays, bit for bit.

    Parameters
    ----------
    options
        Everything it depends on.
    progress
        Told how far each of the two drives is.

    Raises
    ------
    ConfigError
        A drive would take a sensor through steel.
    """
    # One stream per part: another array leaves the world and the mapping drive as they are.
    steel, array, mapping, calibration, lidar = (
        np.random.default_rng(seed) for seed in np.random.SeedSequence(options.seed).spawn(5)
    )
    if options.survey_seed is not None:
        mapping = np.random.default_rng([options.seed, options.survey_seed])
    plan = plan_floor(options.floor_plan)
    world = build_warehouse(options.warehouse, plan, earth_field(options.earth), steel)
    suite, truth = mapping_suite(options.suite), random_array(options.array, array)
    report = progress or _ignore
    return Scenario(
        options=options,
        plan=plan,
        world=world,
        cloud=structure_cloud(world, options.structure, lidar),
        mapping=record(_mapper(options, plan, suite, mapping), world, mapping, report),
        calibration=record(_rover(options, plan, truth, calibration), world, calibration, report),
        suite=suite,
        truth=truth,
    )


def _mapper(
    options: ScenarioOptions,
    plan: FloorPlan,
    sensors: tuple[KnownSensor, ...],
    rng: np.random.Generator,
) -> Vehicle:
    """Return the mapping vehicle on its drive over the whole floor."""
    route = mapping_route(options.mapping_route, plan)
    start_ns = _stamp(options.earth.date, MAPPING_TIME)
    motion = drive(options.mapping_drive, route, start_ns, rng)
    return Vehicle("mapping", sensors, motion, options.mapping_sampling, options.noise)


def _rover(
    options: ScenarioOptions,
    plan: FloorPlan,
    sensors: tuple[KnownSensor, ...],
    rng: np.random.Generator,
) -> Vehicle:
    """Return the vehicle with the array on its calibration drive."""
    route = calibration_route(options.calibration_route, plan)
    start_ns = _stamp(options.earth.date, CALIBRATION_TIME)
    motion = drive(options.calibration_drive, route, start_ns, rng)
    return Vehicle("calibration", sensors, motion, options.calibration_sampling, options.noise)


def _stamp(day: dt.date, time: dt.time) -> int:
    """Return a time of day (UTC) in nanoseconds since 1970."""
    return int(dt.datetime.combine(day, time, tzinfo=dt.UTC).timestamp()) * NANOSECONDS


def _ignore(stage: str, share: float) -> None:
    """Report nothing."""

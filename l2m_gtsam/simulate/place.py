"""Places where vehicles drive: a hall with racks, or a corridor."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.corridor import (
    CorridorOptions,
    corridor_room,
    corridor_route,
    corridor_steel,
    corridor_survey,
    corridor_walls,
    plan_corridor,
)
from l2m_gtsam.simulate.floor_plan import FloorPlan, FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.route import (
    CalibrationRouteOptions,
    MappingRouteOptions,
    calibration_route,
    mapping_route,
)
from l2m_gtsam.simulate.solids import Solids
from l2m_gtsam.simulate.warehouse import WarehouseOptions, build_warehouse
from l2m_gtsam.simulate.world import SteelWorld


@dataclass(frozen=True)
class RouteOptions:
    """Where both vehicles are asked to drive."""

    mapping: MappingRouteOptions
    calibration: CalibrationRouteOptions


@dataclass(frozen=True)
class Place:
    """A place and the ways through it.

    Attributes
    ----------
    plan
        Aisles, and racks where there are any.
    world
        All steel and the Earth's field.
    solids
        Everything that light meets.
    structure
        Of that, what a map is told of as a place of steel.
    mapping_route, calibration_route
        Corner points in the map in metres, shape (M, 2).
    """

    plan: FloorPlan
    world: SteelWorld
    solids: Solids
    structure: Solids
    mapping_route: FloatArray
    calibration_route: FloatArray


def hall(
    floor: FloorPlanOptions,
    steel: WarehouseOptions,
    routes: RouteOptions,
    earth: FloatArray,
    rng: np.random.Generator,
) -> Place:
    """Return a hall with racks, closed by floor, walls and roof.

    Parameters
    ----------
    floor, steel, routes
        What stands where, and where vehicles drive.
    earth
        The Earth's field in the map frame in microtesla, shape (3,).
    rng
        Source of randomness of the steel.
    """
    plan = plan_floor(floor)
    world = build_warehouse(steel, plan, earth, rng)
    roof = steel.hall_height + steel.hall_beam.height
    room = Solids.spanned(np.zeros(3), np.array([plan.length, plan.width, roof]))
    bodies = Solids.of(world)
    return Place(
        plan,
        world,
        room.joined(bodies),
        bodies,
        mapping_route(routes.mapping, plan),
        calibration_route(routes.calibration, plan),
    )


def corridor(
    options: CorridorOptions,
    steel: WarehouseOptions,
    routes: RouteOptions,
    earth: FloatArray,
    rng: np.random.Generator,
) -> Place:
    """Return a corridor whose steel is hidden by smooth walls; parameters as in ``hall``."""
    plan = plan_corridor(options)
    world = build_warehouse(corridor_steel(options, steel), plan, earth, rng)
    return Place(
        plan,
        world,
        corridor_room(options).joined(Solids.of(world)),
        corridor_walls(options),
        corridor_survey(options, routes.mapping),
        corridor_route(options, routes.calibration),
    )

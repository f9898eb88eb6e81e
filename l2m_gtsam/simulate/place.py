"""Places where vehicles drive: a hall with racks, or a corridor."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, joined_rows
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.floor_plan import NARROWEST_AISLE, FloorPlan, FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.route import (
    CalibrationRouteOptions,
    MappingRouteOptions,
    calibration_route,
    lanes_of,
    mapping_route,
    to_and_fro,
)
from l2m_gtsam.simulate.solids import Solids
from l2m_gtsam.simulate.warehouse import WarehouseOptions, build_warehouse
from l2m_gtsam.simulate.world import SteelWorld

MARGIN = 2.0  # metres that drives keep from the ends, for turning
LANE_SHARE = 0.15  # of the width: distance of the paths there and back from its middle


class CorridorOptions(Options):
    """A corridor along the map's x axis, with steel of `warehouse`'s sections and magnetisation."""

    length: Annotated[float, Field(gt=2 * MARGIN)] = 60.0
    """Length that is driven and has steel, in metres."""
    width: Annotated[float, Field(ge=NARROWEST_AISLE)] = 4.0
    """Distance of the walls in metres."""
    height: Annotated[float, Field(ge=NARROWEST_AISLE)] = 3.0
    """Height of the ceiling above the floor in metres."""
    beyond: Annotated[float, Field(ge=0)] = 100.0
    """The corridor goes on so far past both ends, in metres: as long as this is more than the
    LiDAR's range, the position along the corridor is unobservable."""
    frame_pitch: Annotated[float, Field(gt=0)] = 3.0
    """Largest distance of neighbouring frames of steel in metres: posts behind both walls, beams
    over the ceiling and under the floor."""
    rebar_pitch: Annotated[float, Field(gt=0)] = 2.0
    """Side of the floor's squares, each with one bundle of bars at a random place, in metres."""


def plan_corridor(options: CorridorOptions) -> FloorPlan:
    """Return a corridor as a floor of one aisle without racks."""
    return FloorPlan(
        length=options.length,
        width=options.width,
        aisle_y=np.array([options.width / 2]),
        aisle_width=options.width,
        cross_x=np.zeros(0),
        cross_width=0.0,
        rack_y=np.zeros((0, 2)),
        block_x=np.zeros((0, 2)),
    )


def corridor_steel(options: CorridorOptions, warehouse: WarehouseOptions) -> WarehouseOptions:
    """Return the options of the steel around a corridor."""
    return warehouse.model_copy(
        update={
            "hall_height": options.height,
            "post_pitch": options.frame_pitch,
            "rebar_pitch": options.rebar_pitch,
        }
    )


def corridor_room(options: CorridorOptions) -> Solids:
    """Return floor, walls and ceiling, which go on past both ends."""
    low = np.array([-options.beyond, 0.0, 0.0])
    high = np.array([options.length + options.beyond, options.width, options.height])
    return Solids.spanned(low, high)


def corridor_walls(options: CorridorOptions) -> Solids:
    """Return the walls along the stretch with steel, as plates without thickness."""
    y = np.array([0.0, options.width])
    low = np.column_stack([np.zeros(2), y, np.zeros(2)])
    high = np.column_stack([np.full(2, options.length), y, np.full(2, options.height)])
    return Solids.spanned(low, high)


def corridor_survey(options: CorridorOptions, route: MappingRouteOptions) -> FloatArray:
    """Return a route over all lanes of a corridor, corner points in metres, shape (M, 2)."""
    across = lanes_of(route, np.array([options.width / 2]), options.width)
    return to_and_fro(across, MARGIN, options.length - MARGIN)


def corridor_route(options: CorridorOptions, route: CalibrationRouteOptions) -> FloatArray:
    """Return a route from end to end and back, ``route.laps`` times, shape (M, 2) in metres."""
    start, end = MARGIN, options.length - MARGIN
    low, high = (0.5 + LANE_SHARE * np.array([-1.0, 1.0])) * options.width
    lap = np.array([[start, low], [end, low], [end, high], [start, high]])
    return np.concatenate([np.tile(lap, (route.laps, 1)), lap[:1]])


@dataclass(frozen=True)
class RouteOptions:
    """Where both vehicles are asked to drive."""

    mapping: MappingRouteOptions
    calibration: CalibrationRouteOptions


@dataclass(frozen=True)
class SimulatedPlace:
    """A place and the routes through it.

    Attributes
    ----------
    plan
        Aisles, and racks where there are any.
    world
        All steel and the Earth's field.
    solids
        Everything that light meets.
    structure
        Of that, what a map is given as the surfaces of steel.
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
) -> SimulatedPlace:
    """Return a hall with racks, closed by floor, walls and roof.

    Parameters
    ----------
    floor, steel, routes
        Racks, steel, and where vehicles drive.
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
    return SimulatedPlace(
        plan,
        world,
        joined_rows([room, bodies]),
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
) -> SimulatedPlace:
    """Return a corridor whose steel is hidden by smooth walls; parameters as in ``hall``."""
    plan = plan_corridor(options)
    world = build_warehouse(corridor_steel(options, steel), plan, earth, rng)
    return SimulatedPlace(
        plan,
        world,
        joined_rows([corridor_room(options), Solids.of(world)]),
        corridor_walls(options),
        corridor_survey(options, routes.mapping),
        corridor_route(options, routes.calibration),
    )

"""Routes over a warehouse floor, as corner points that a drive rounds off."""

from typing import Annotated

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.floor_plan import FloorPlan

POINTS_PER_TURN = 48


class MappingRouteOptions(Options):
    """How the aisles are swept for a map."""

    lane_pitch: Annotated[float, Field(gt=0)] = 1.2
    """Distance of neighbouring lanes in one aisle, in metres."""
    clearance: Annotated[float, Field(gt=0)] = 0.7
    """Least distance from a lane to the racks or walls beside its aisle, in metres."""


class CalibrationRouteOptions(Options):
    """How a vehicle is driven to calibrate its sensors."""

    turns: Annotated[int, Field(ge=0)] = 3
    """Full circles in each of the two cross aisles, one way in the first, the other in the next."""
    turn_radius: Annotated[float, Field(gt=0)] = 0.8
    """Radius of the circles in metres."""
    laps: Annotated[int, Field(ge=1)] = 1
    """How often the loop round a block of racks is driven."""


def mapping_route(options: MappingRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route over all lanes of all aisles, then of all cross aisles.

    Parameters
    ----------
    options
        Spacing of the lanes.
    plan
        Where aisles lie.

    Returns
    -------
    Corner points in the map in metres, shape (M, 2).
    """
    y = _lanes(options, plan.aisle_y, plan.aisle_width)
    x = _lanes(options, plan.cross_x, plan.cross_width)
    along = _serpentine(y, x[0], x[-1])
    # The sweep along x ends on the outermost cross lane of one side: go on from there.
    if along[-1, 0] == x[-1]:
        x = x[::-1]
    across = _serpentine(x, y[-1], y[0])[:, ::-1]
    return np.concatenate([along, across])


def calibration_route(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route round a block of racks in the middle, circling in both cross aisles.

    The circles turn the vehicle through all headings, both ways; the loop takes it past the
    steel of the racks.

    Parameters
    ----------
    options
        Number and size of the circles.
    plan
        Where aisles lie.

    Returns
    -------
    Corner points in the map in metres, shape (M, 2).
    """
    row, block = (len(plan.rack_y) - 1) // 2, (len(plan.block_x) - 1) // 2
    y_low, y_high = plan.aisle_y[row : row + 2]
    x_low, x_high = plan.cross_x[block : block + 2]
    # The drive passes both cross aisles on their right-hand side, where their circles begin.
    x_low, x_high = x_low + options.turn_radius, x_high + options.turn_radius
    middle, reach = (y_low + y_high) / 2, (y_high - y_low) / 4
    up = _coil(options, x_high, middle - reach, middle + reach, options.turns)
    down = _coil(options, x_low, middle + reach, middle - reach, -options.turns)
    corners = [[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]]
    lap = np.concatenate([corners[:2], up, corners[2:], down])
    return np.concatenate([np.tile(lap, (options.laps, 1)), lap[:1]])


def _lanes(options: MappingRouteOptions, centres: FloatArray, width: float) -> FloatArray:
    """Return the lanes, ascending, of aisles with these centre lines and this width."""
    gaps = max(0, int((width - 2 * options.clearance) / options.lane_pitch))
    offsets = (np.arange(gaps + 1) - gaps / 2) * options.lane_pitch
    return np.asarray((centres[:, None] + offsets).ravel())


def _serpentine(lanes: FloatArray, start: float, end: float) -> FloatArray:
    """Return (along, lane) of a path that runs each lane, to and fro, shape (2 L, 2)."""
    along = np.tile([start, end, end, start], (len(lanes) + 1) // 2)[: 2 * len(lanes)]
    return np.column_stack([along, np.repeat(lanes, 2)])


def _coil(
    options: CalibrationRouteOptions, x: float, y_start: float, y_end: float, turns: int
) -> FloatArray:
    """Return circles left of ``x`` that drift from one y to another; negative turns clockwise."""
    share = np.linspace(0.0, 1.0, abs(turns) * POINTS_PER_TURN + 1)
    angle = 2 * np.pi * turns * share
    radius = options.turn_radius
    return np.column_stack(
        [
            x - radius + radius * np.cos(angle),
            y_start + (y_end - y_start) * share + radius * np.sin(angle),
        ]
    )

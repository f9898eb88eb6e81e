"""Routes over a warehouse floor, as corner points that a drive rounds off."""

from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.floor_plan import FloorPlan

POINTS_PER_TURN = 48
ASIDE = 0.4  # metres beside the middle of an aisle: what is swept for a map lies beyond
SERPENTINE_AISLES = 4
WAVE_LENGTH, POINTS_PER_WAVE = 6.0, 24  # of a slalom, in metres


class MappingRouteOptions(Options):
    """How the aisles are swept for a map."""

    lane_pitch: Annotated[float, Field(gt=0)] = 1.2
    """Distance of neighbouring lanes in one aisle, in metres."""
    clearance: Annotated[float, Field(gt=0)] = 0.7
    """Least distance from a lane to the racks or walls beside its aisle, in metres."""


class RouteShape(StrEnum):
    """A path through the aisles."""

    CIRCLES = "circles"
    EIGHT = "eight"
    SERPENTINE = "serpentine"
    SLALOM = "slalom"
    WANDER = "wander"
    LOOP = "loop"


class CalibrationRouteOptions(Options):
    """How a vehicle is driven to calibrate its sensors."""

    shape: RouteShape = RouteShape.CIRCLES
    """`circles` (round a block of racks, with circles in both cross aisles), `eight` (round two
    blocks, one way and then the other), `serpentine` (to and fro through neighbouring aisles),
    `slalom` (round a block, weaving), `wander` (from crossing to crossing at random), or `loop`
    (round all racks, along the outermost aisles)."""
    length: Annotated[float, Field(gt=0)] = 100.0
    """Of `wander`, in metres."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Of `wander`."""

    turns: Annotated[int, Field(ge=0)] = 3
    """Full circles in each of the two cross aisles, one way in the first, the other in the next."""
    turn_radius: Annotated[float, Field(gt=0)] = 0.8
    """Radius of the circles in metres."""
    laps: Annotated[int, Field(ge=1)] = 1
    """How often the route is driven."""


def mapping_route(options: MappingRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route over all lanes of all aisles, then of all cross aisles.

    Returns
    -------
    Corner points in the map in metres, shape (M, 2).
    """
    y = lanes_of(options, plan.aisle_y, plan.aisle_width)
    x = lanes_of(options, plan.cross_x, plan.cross_width)
    along = to_and_fro(y, x[0], x[-1])
    # The sweep along x ends on the outermost cross lane of one side: go on from there.
    if along[-1, 0] == x[-1]:
        x = x[::-1]
    across = to_and_fro(x, y[-1], y[0])[:, ::-1]
    return np.concatenate([along, across])


def calibration_route(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return the route of a calibration drive.

    Parameters
    ----------
    options
        Number and size of the circles.

    Returns
    -------
    Corner points in the map in metres, shape (M, 2).
    """
    lap = SHAPES[options.shape](options, plan)
    return np.concatenate([np.tile(lap, (options.laps, 1)), lap[:1]])


def circles(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route round a block of racks in the middle, circling in both cross aisles.

    The circles turn the vehicle through all headings, both ways; the loop takes it past the
    steel of the racks.
    """
    row, block = _middle(plan)
    y_low, y_high = plan.aisle_y[row : row + 2]
    x_low, x_high = plan.cross_x[block : block + 2]
    # The drive passes both cross aisles on their right-hand side, where their circles begin.
    x_low, x_high = x_low + options.turn_radius, x_high + options.turn_radius
    middle, reach = (y_low + y_high) / 2, (y_high - y_low) / 4
    up = _coil(options, x_high, middle - reach, middle + reach, options.turns)
    down = _coil(options, x_low, middle + reach, middle - reach, -options.turns)
    corners = [[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]]
    return np.concatenate([corners[:2], up, corners[2:], down])


def eight(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route round two neighbouring blocks, or twice round the only one.

    The second is driven round the other way, along other lines of the aisles.
    """
    row, block = _middle(plan)
    other = min(block + 1, len(plan.block_x) - 1)
    first = _block_corners(plan, row, block, aside=-ASIDE)[[1, 2, 3, 0]]
    return np.concatenate([first, _block_corners(plan, row, other, aside=ASIDE)[[0, 3, 2, 1]]])


def serpentine(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route to and fro through up to four aisles beside each other."""
    row, block = _middle(plan)
    x_low, x_high = plan.cross_x[block : block + 2]
    first = max(0, min(row, len(plan.aisle_y) - SERPENTINE_AISLES))
    lanes = plan.aisle_y[first : first + SERPENTINE_AISLES]
    return to_and_fro(lanes, x_low, x_high)


def slalom(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route round a block in the middle that weaves from side to side."""
    corners = _block_corners(plan, *_middle(plan), aside=0.0)
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.concatenate([_woven(start, end) for start, end in sides])


def wander(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route from crossing to crossing at random, never at once back, then home."""
    rng = np.random.default_rng(options.seed)
    x, y = plan.cross_x, plan.aisle_y
    home = (len(x) // 2, len(y) // 2)
    crossings, travelled = [home], 0.0
    while travelled < options.length:
        (i, j), before = crossings[-1], crossings[-2:-1]
        around = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        inside = [(m, n) for m, n in around if 0 <= m < len(x) and 0 <= n < len(y)]
        onwards = [crossing for crossing in inside if [crossing] != before]
        m, n = onwards[rng.integers(len(onwards))]
        crossings.append((m, n))
        travelled += float(abs(x[m] - x[i]) + abs(y[n] - y[j]))
    crossings.append((home[0], crossings[-1][1]))
    corners = np.array([[x[i], y[j]] for i, j in crossings])
    return np.asarray(corners + rng.uniform(-ASIDE, ASIDE, corners.shape))


def loop(options: CalibrationRouteOptions, plan: FloorPlan) -> FloatArray:
    """Return a route round all racks, along the outermost aisles."""
    (x_low, x_high), (y_low, y_high) = plan.cross_x[[0, -1]], plan.aisle_y[[0, -1]]
    return np.array([[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]])


SHAPES = {
    RouteShape.CIRCLES: circles,
    RouteShape.EIGHT: eight,
    RouteShape.SERPENTINE: serpentine,
    RouteShape.SLALOM: slalom,
    RouteShape.WANDER: wander,
    RouteShape.LOOP: loop,
}


def _middle(plan: FloorPlan) -> tuple[int, int]:
    """Return row and block of the racks in the middle."""
    return (len(plan.rack_y) - 1) // 2, (len(plan.block_x) - 1) // 2


def _block_corners(plan: FloorPlan, row: int, block: int, aside: float) -> FloatArray:
    """Return the crossings round a block anticlockwise, moved outwards by metres, shape (4, 2)."""
    (x_low, x_high), (y_low, y_high) = plan.cross_x[block : block + 2], plan.aisle_y[row : row + 2]
    x_low, x_high, y_low, y_high = x_low - aside, x_high + aside, y_low - aside, y_high + aside
    return np.array([[x_low, y_low], [x_high, y_low], [x_high, y_high], [x_low, y_high]])


def _woven(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return a wave from one corner to another, without the other, shape (M, 2)."""
    side = end - start
    length = float(np.hypot(*side))
    waves = max(1, round(length / WAVE_LENGTH))
    share = np.arange(waves * POINTS_PER_WAVE) / (waves * POINTS_PER_WAVE)
    left = np.array([-side[1], side[0]]) / length
    return start + share[:, None] * side + ASIDE * np.sin(2 * np.pi * waves * share)[:, None] * left


def lanes_of(options: MappingRouteOptions, centres: FloatArray, width: float) -> FloatArray:
    """Return the lanes, ascending, of aisles with these centre lines and this width."""
    gaps = max(0, int((width - 2 * options.clearance) / options.lane_pitch))
    offsets = (np.arange(gaps + 1) - gaps / 2) * options.lane_pitch
    return np.asarray((centres[:, None] + offsets).ravel())


def to_and_fro(lanes: FloatArray, start: float, end: float) -> FloatArray:
    """Return (along, lane) of a path that runs each lane, to and fro, shape (2 L, 2)."""
    along = np.tile([start, end, end, start], (len(lanes) + 1) // 2)[: 2 * len(lanes)]
    return np.column_stack([along, np.repeat(lanes, 2)])


def _coil(
    options: CalibrationRouteOptions, x: float, y_start: float, y_end: float, turns: int
) -> FloatArray:
    """Return circles left of ``x`` that drift from one y to another; negative turns clockwise."""
    share = np.linspace(0.0, 1.0, abs(turns) * POINTS_PER_TURN + 1)
    # A spiral whose middle drifts: successive circles pass other places of the aisle.
    angle = 2 * np.pi * turns * share
    radius = options.turn_radius
    return np.column_stack(
        [
            x - radius + radius * np.cos(angle),
            y_start + (y_end - y_start) * share + radius * np.sin(angle),
        ]
    )

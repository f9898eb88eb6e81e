"""Routes of calibration drives: clear of racks, within the aisles, of the length asked for."""

from itertools import pairwise

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.floor_plan import FloorPlan, FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.route import CalibrationRouteOptions, RouteShape, calibration_route

HALLS = [
    FloorPlanOptions(),
    FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1),
    FloorPlanOptions(length=60.0, width=25.0, rack_rows=3, blocks=3),
]
CLEAR = 0.9  # metres from racks and walls: half a vehicle and what corners are rounded by


def densified(corners: FloatArray) -> FloatArray:
    """Return points along a polygon every few centimetres, shape (M, 2)."""
    share = np.linspace(0, 1, 200)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])


def clearance(plan: FloorPlan, points: FloatArray) -> float:
    """Return the least distance of points from racks and walls in metres."""
    walls = np.column_stack([points, np.array([plan.length, plan.width]) - points]).min()
    racks = [
        np.hypot(
            np.maximum(np.maximum(x0 - points[:, 0], points[:, 0] - x1), 0),
            np.maximum(np.maximum(y0 - points[:, 1], points[:, 1] - y1), 0),
        ).min()
        for x0, x1 in plan.block_x
        for y0, y1 in plan.rack_y
    ]
    return float(min(walls, *racks))


@pytest.mark.parametrize("hall", HALLS, ids=["large", "small", "wide"])
@pytest.mark.parametrize("shape", RouteShape)
def test_a_route_is_closed_and_clear_of_racks_and_walls(
    shape: RouteShape, hall: FloorPlanOptions
) -> None:
    plan = plan_floor(hall)
    corners = calibration_route(CalibrationRouteOptions(shape=shape), plan)
    np.testing.assert_array_equal(corners[0], corners[-1])
    assert clearance(plan, densified(corners)) > CLEAR


@pytest.mark.parametrize("hall", HALLS, ids=["large", "small", "wide"])
def test_a_loop_goes_round_all_racks(hall: FloorPlanOptions) -> None:
    plan = plan_floor(hall)
    x, y = calibration_route(CalibrationRouteOptions(shape=RouteShape.LOOP, laps=3), plan).T
    assert x.min() < plan.block_x.min()
    assert x.max() > plan.block_x.max()
    assert y.min() < plan.rack_y.min()
    assert y.max() > plan.rack_y.max()
    assert len(x) == 3 * 4 + 1


def test_routes_of_all_shapes_differ_and_repeat() -> None:
    plan = plan_floor(HALLS[0])
    routes = [calibration_route(CalibrationRouteOptions(shape=each), plan) for each in RouteShape]
    for index, each in enumerate(routes):
        shape = list(RouteShape)[index]
        again = calibration_route(CalibrationRouteOptions(shape=shape), plan)
        np.testing.assert_array_equal(each, again)
        for other in routes[:index]:
            assert each.shape != other.shape or not np.allclose(each, other)


@pytest.mark.parametrize("seed", range(5))
def test_a_walk_is_at_least_as_long_as_asked(seed: int) -> None:
    options = CalibrationRouteOptions(shape=RouteShape.WANDER, seed=seed, length=150.0)
    corners = calibration_route(options, plan_floor(HALLS[0]))
    # Each corner stands up to 0.4 m aside: its legs lose at most as much at both ends.
    assert np.hypot(*np.diff(corners, axis=0).T).sum() > 0.9 * options.length


def test_laps_repeat_a_route() -> None:
    plan = plan_floor(HALLS[0])
    once, twice = (
        calibration_route(CalibrationRouteOptions(shape=RouteShape.EIGHT, laps=laps), plan)
        for laps in (1, 2)
    )
    np.testing.assert_array_equal(twice, np.concatenate([once[:-1], once]))

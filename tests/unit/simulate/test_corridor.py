"""A corridor in which light says nothing of the way along it, and the magnetic field does."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions
from l2m_gtsam.simulate.lidar import SpinningLidarOptions
from l2m_gtsam.simulate.place import CorridorOptions, RouteOptions, SimulatedPlace, corridor, hall
from l2m_gtsam.simulate.route import CalibrationRouteOptions, MappingRouteOptions
from l2m_gtsam.simulate.scenario import ScenarioOptions, simulate
from l2m_gtsam.simulate.sensors import MappingSuiteOptions, SamplingOptions, SensorArrayOptions
from l2m_gtsam.simulate.solids import Solids
from l2m_gtsam.simulate.warehouse import WarehouseOptions
from tests.worlds.ray_cast import snapshots

EARTH = np.array([20.0, 0.0, -45.0])
OPTIONS = CorridorOptions()
ROUTES = RouteOptions(MappingRouteOptions(), CalibrationRouteOptions(laps=2))


@cache
def featureless() -> SimulatedPlace:
    return corridor(OPTIONS, WarehouseOptions(), ROUTES, EARTH, np.random.default_rng(1))


@cache
def furnished() -> SimulatedPlace:
    floor = FloorPlanOptions(length=30.0, width=16.0, rack_rows=2)
    return hall(floor, WarehouseOptions(), ROUTES, EARTH, np.random.default_rng(1))


def standing(*places: tuple[float, float, float]) -> Trajectory:
    stamps = np.arange(len(places), dtype=np.int64)
    R = np.tile(np.eye(3), (len(places), 1, 1))
    return Trajectory(stamps, R, np.array(places), "map", "lidar")


def seen(solids: Solids, options: SpinningLidarOptions, *places: tuple[float, float, float]) -> Any:
    return [scan.points for scan in snapshots(solids, options, standing(*places))]


def information(points: FloatArray, thickness: float) -> tuple[FloatArray, FloatArray]:
    """What planes fitted to neighbours say of a translation: the mean of n n^T, its eigenvalues
    and eigenvectors, the least first. Patches that are thicker, relative to their breadth, are
    edges."""
    _, near = KDTree(points).query(points[::7], 16)
    patches = points[near] - points[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))
    flat = values[:, 0] < thickness**2 * values[:, 1]
    normals = vectors[flat, :, 0]
    assert len(normals) > 500
    found = np.linalg.eigh(normals.T @ normals / len(normals))
    return found.eigenvalues, found.eigenvectors


def test_scans_are_the_same_wherever_along_the_corridor() -> None:
    exact = SpinningLidarOptions(noise=0.0)
    here, there = seen(featureless().solids, exact, (11.0, 2.3, 0.8), (48.3, 2.3, 0.8))
    # Of coordinates of up to 160 m, in double precision.
    np.testing.assert_allclose(here, there, rtol=0, atol=1e-10)


def test_scan_matching_knows_nothing_of_the_way_along_and_in_a_hall_it_does() -> None:
    dense = SpinningLidarOptions(beams=64, columns=1800, furthest=15.0, noise=0.0)
    (points,) = seen(featureless().solids, dense, (30.0, 2.3, 0.8))
    values, vectors = information(points, 1e-6)
    assert values[0] < 1e-12  # of normals, squared: rounding of metres over centimetres
    assert values[1] > 0.2
    assert abs(vectors[0, 0]) == pytest.approx(1.0, abs=1e-9)
    (points,) = seen(furnished().solids, dense, (3.0, 8.0, 0.8))
    values, _ = information(points, 1e-6)
    assert values[0] > 0.05
    # With noise, fitted planes lean by it: it looks like information, and is none.
    noisy = dense.model_copy(update={"noise": 0.005})
    (points,) = seen(featureless().solids, noisy, (30.0, 2.3, 0.8))
    values, _ = information(points, 0.2)
    assert values[0] < 0.1 * values[1]


def test_steel_is_hidden_and_shapes_the_field_along_the_way() -> None:
    place = featureless()
    inside = np.array([[-1.0, 0.0, 0.0], [OPTIONS.length + 1, OPTIONS.width, OPTIONS.height]])
    corners = Solids.of(place.world).vertices().reshape(-1, 8, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    # Beams lie on the ceiling: closer than rounding.
    apart = np.any((low >= inside[1] - 1e-9) | (high <= inside[0] + 1e-9), axis=1)
    assert apart.all()
    assert {"post", "hall beam", "rebar"} == set(place.world.kinds)
    x = np.arange(2.0, 58.0, 0.1)
    way = np.column_stack([x, np.full_like(x, 2.0), np.full_like(x, 0.5)])
    field = place.world.field(way)
    assert np.linalg.norm(field.std(axis=0)) > 3.0  # uT, of noise of some 0.1
    slope = np.linalg.norm(np.gradient(field, x, axis=0), axis=1)
    assert np.mean(slope > 0.5) > 0.9  # uT/m: the way along shows nearly everywhere


def test_routes_go_to_and_fro_within_the_walls() -> None:
    place = featureless()
    there = place.calibration_route
    np.testing.assert_array_equal(there[0], there[-1])
    np.testing.assert_array_equal(there[:4], there[4:8])
    for route in (there, place.mapping_route):
        assert route[:, 0].min() == 2.0
        assert route[:, 0].max() == 58.0
        assert route[:, 1].min() >= 0.7
        assert route[:, 1].max() <= OPTIONS.width - 0.7


def test_a_map_is_told_of_the_walls_that_hide_steel() -> None:
    scenario = simulate(
        ScenarioOptions(
            corridor=CorridorOptions(length=8.0),
            suite=MappingSuiteOptions(lateral=(0.0,), heights=(0.0,)),
            array=SensorArrayOptions(count=1),
            mapping_sampling=SamplingOptions(field_rate=1.0, pose_rate=1.0),
            calibration_sampling=SamplingOptions(field_rate=1.0, pose_rate=1.0),
        )
    )
    noise = scenario.options.structure.noise
    y = scenario.cloud[:, 1]
    assert np.minimum(np.abs(y), np.abs(y - 4.0)).max() < 6 * noise
    assert scenario.cloud[:, 0].max() < 8.0 + 6 * noise
    assert len(scenario.plan.rack_y) == 0


@pytest.mark.parametrize("wrong", [{"length": 3.0}, {"width": 1.0}, {"height": 1.0}])
def test_a_corridor_that_is_too_small_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        CorridorOptions(**wrong)

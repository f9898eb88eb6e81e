"""The simulated structure cloud: on the steel's surfaces, evenly, above the floor only."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.structure import StructureOptions, structure_cloud
from l2m_gtsam.simulate.warehouse import WarehouseOptions, build_warehouse
from l2m_gtsam.simulate.world import SteelWorld

EXACT = StructureOptions(noise=0.0)
ROUNDING = 1e-9  # metres


def body(size: FloatArray, centre: FloatArray, R: FloatArray) -> SteelWorld:
    return SteelWorld(("post",), size[None], centre[None], R[None], np.zeros((1, 3)), np.zeros(3))


def cloud_of(world: SteelWorld, options: StructureOptions = EXACT) -> FloatArray:
    return structure_cloud(world, options, np.random.default_rng(0))


def up_to(height: float) -> StructureOptions:
    return StructureOptions(noise=0.0, height=height)


@pytest.fixture(scope="module")
def hall() -> SteelWorld:
    plan = plan_floor(FloorPlanOptions(length=16.0, width=9.0, rack_rows=1, blocks=1))
    return build_warehouse(WarehouseOptions(), plan, np.zeros(3), np.random.default_rng(1))


def only(world: SteelWorld, index: int) -> SteelWorld:
    """The world with one of its bodies."""
    return body(world.dimensions[index], world.centres[index], world.R_map_body[index])


def test_points_cover_the_surface_and_nothing_else() -> None:
    """A tilted box, half under the floor, against points drawn on its faces at random."""
    rng = np.random.default_rng(2)
    size, centre = np.array([0.4, 1.1, 2.0]), np.array([3.0, -2.0, 0.3])
    R = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    found = cloud_of(body(size, centre, R), up_to(1.0))
    in_body = np.abs((found - centre) @ R) / (size / 2)
    np.testing.assert_allclose(in_body.max(axis=1), 1.0, atol=ROUNDING)
    drawn = rng.uniform(-0.5, 0.5, (20_000, 3))
    axis = rng.integers(0, 3, len(drawn))
    drawn[np.arange(len(drawn)), axis] = rng.choice([-0.5, 0.5], len(drawn))
    faces = (drawn * size) @ R.T + centre
    # Next to the cuts at 0 and 1 m, the nearest point of the grid may be beyond the cut.
    faces = faces[(faces[:, 2] > 0.05) & (faces[:, 2] < 0.95)]
    distance, _ = cKDTree(found).query(faces)
    assert np.max(distance) <= EXACT.spacing / np.sqrt(2) + ROUNDING


def test_points_stand_for_equal_shares_of_a_face() -> None:
    """The number of points is the surface divided by the area of a cell."""
    world = body(np.array([0.5, 1.0, 2.0]), np.array([0.0, 0, 1.5]), np.eye(3))
    found = cloud_of(world)
    surface = 2 * (0.5 * 1.0 + 0.5 * 2.0 + 1.0 * 2.0)
    assert len(found) == round(surface / EXACT.spacing**2)


def test_a_hall_is_seen_above_its_floor_only(hall: SteelWorld) -> None:
    seen = [len(cloud_of(only(hall, index))) > 0 for index in range(len(hall))]
    expected = [kind in ("post", "upright", "rack beam") for kind in hall.kinds]
    assert seen == expected
    under_the_roof = hall.centres[:, 2] > 0
    high = [len(cloud_of(only(hall, k), up_to(9.0))) > 0 for k in range(len(hall))]
    assert high == under_the_roof.tolist()
    assert under_the_roof[np.array(hall.kinds) == "hall beam"].any()


def test_the_hall_is_the_sum_of_its_bodies(hall: SteelWorld) -> None:
    found = cloud_of(hall)
    parts = [cloud_of(only(hall, index)) for index in range(len(hall))]
    np.testing.assert_array_equal(found, np.concatenate(parts))
    assert found[:, 2].min() > 0
    assert found[:, 2].max() <= EXACT.height
    swollen = replace(hall, dimensions=hall.dimensions + ROUNDING)
    assert swollen.inside(found).all()


def test_noise_is_as_large_as_said_and_repeatable(hall: SteelWorld) -> None:
    options = StructureOptions(noise=0.03)
    noise = cloud_of(hall, options) - cloud_of(hall)
    # 4 standard errors of a standard deviation and of a mean of this many numbers.
    count = noise.size
    assert count > 10_000
    assert abs(noise.std() / 0.03 - 1) < 4 / np.sqrt(2 * count)
    assert abs(noise.mean()) < 4 * 0.03 / np.sqrt(count)
    np.testing.assert_array_equal(cloud_of(hall, options), cloud_of(hall, options))


def test_without_steel_there_is_no_cloud() -> None:
    nothing = SteelWorld(
        (), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(3)
    )
    assert cloud_of(nothing).shape == (0, 3)

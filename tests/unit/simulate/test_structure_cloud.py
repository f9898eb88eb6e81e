"""The simulated structure cloud: on the steel's surfaces, evenly, above the floor only.

And what a cloud that has a floor, level or a ramp, suggests as sources.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.structure import StructureOptions as VoxelOptions
from l2m_gtsam.maps.harmonic.structure import candidate_sources
from l2m_gtsam.simulate.floor_plan import FloorPlanOptions, plan_floor
from l2m_gtsam.simulate.solids import StructureCloudOptions, structure_cloud
from l2m_gtsam.simulate.warehouse import WarehouseOptions, build_warehouse
from l2m_gtsam.simulate.world import SteelWorld

EXACT = StructureCloudOptions(noise=0.0)
ROUNDING = 1e-9  # metres
VOXELS = VoxelOptions()
PASSES = (0.4, 0.7, 1.0)  # heights of sensors over the floor in metres
# Slopes up to those of fifteen degrees, and where they rise to: 0 is along the drive, 90 across.
RAMPS = [(0.1, 45), (0.15, 0), (0.15, 90), (0.2, 200), (0.27, 0), (0.27, 70)]
LEVEL_OR_NOT = pytest.mark.parametrize(("slope", "turn"), [(0.0, 0), *RAMPS])


def body(size: FloatArray, centre: FloatArray, R: FloatArray) -> SteelWorld:
    return SteelWorld(("post",), size[None], centre[None], R[None], np.zeros((1, 3)), np.zeros(3))


def cloud_of(world: SteelWorld, options: StructureCloudOptions = EXACT) -> FloatArray:
    return structure_cloud(world, options, np.random.default_rng(0))


def up_to(height: float) -> StructureCloudOptions:
    return StructureCloudOptions(noise=0.0, height=height)


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
    options = StructureCloudOptions(noise=0.03)
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


def on_ramp(points: FloatArray, slope: float, turn: float) -> FloatArray:
    """Lift points over a level floor by a ramp that rises towards ``turn`` degrees from x."""
    ahead = np.array([np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))])
    return points + np.outer(slope * points[:, :2] @ ahead, [0.0, 0.0, 1.0])


def lattice(low: tuple[float, float], high: tuple[float, float], z: float) -> FloatArray:
    """Points every 5 cm of a level rectangle."""
    x, y = np.meshgrid(*(np.arange(a, b, 0.05) for a, b in zip(low, high, strict=True)))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def lanes(heights: tuple[float, ...], y: tuple[float, ...] = (0.0,)) -> FloatArray:
    """Readings along x, every 5 cm, at heights over a level floor."""
    x = np.arange(0.0, 6.0, 0.05)
    return np.array([(each, lane, z) for z in heights for lane in y for each in x])


def post(y: float, top: float) -> FloatArray:
    """The sides of a square post of 0.3 m beside the drive's middle, from a level floor on."""
    ring = lattice((2.9, y - 0.15), (3.2, y + 0.15), 0.0)
    ring = ring[np.abs(ring[:, :2] - [3.025, y - 0.025]).max(axis=1) > 0.12]
    up = np.outer(np.arange(0.0, top, 0.05), [0.0, 0.0, 1.0])
    return np.asarray(ring + up[:, None]).reshape(-1, 3)


FLOOR = lattice((-1.5, -3.0), (7.5, 3.0), 0.0)
GRID = (-1.6, -0.8, 0.0, 0.8)  # metres, the lanes of a survey of an area


def voxels_of(points: FloatArray) -> set[tuple[int, ...]]:
    return {tuple(row) for row in np.floor(points / VOXELS.edge).astype(int).tolist()}


def found_of(cloud: FloatArray, readings: FloatArray) -> set[tuple[int, ...]]:
    return voxels_of(candidate_sources(cloud, readings, VOXELS).positions)


@pytest.mark.parametrize("heights", [(0.15,), (0.2,), (0.3,), PASSES])
@LEVEL_OR_NOT
def test_a_bare_ramp_makes_no_sources(
    slope: float, turn: float, heights: tuple[float, ...]
) -> None:
    """A drive up, across or askew, of one lane or of many."""
    floor = on_ramp(FLOOR, slope, turn)
    for y in ((0.0,), GRID):
        assert not found_of(floor, on_ramp(lanes(heights, y), slope, turn))


@pytest.mark.parametrize(("slope", "turn"), RAMPS)
def test_a_bare_ramp_that_is_seen_with_noise_makes_no_sources(slope: float, turn: float) -> None:
    noise = np.random.default_rng(4).normal(0.0, 0.01, FLOOR.shape)
    readings = on_ramp(lanes((0.2,), GRID), slope, turn)
    assert not found_of(on_ramp(FLOOR, slope, turn) + noise, readings)


def test_a_ramp_that_is_not_driven_on_makes_no_sources() -> None:
    """It begins beside the drive, 0.3 m away; the readings know nothing of it."""
    ramp = FLOOR + np.outer(0.25 * np.maximum(FLOOR[:, 1] - 0.3, 0.0), [0.0, 0.0, 1.0])
    assert not found_of(ramp, lanes((0.2,)))


@pytest.mark.parametrize("side", [-0.7, 0.7, 1.2])
@pytest.mark.parametrize("heights", [(0.2,), (0.4,), PASSES])
@LEVEL_OR_NOT
def test_a_post_on_a_ramp_is_kept_whole(
    slope: float, turn: float, heights: tuple[float, ...], side: float
) -> None:
    """All its voxels from where it is followed, half a metre below the readings; no others."""
    steel = on_ramp(post(side, 1.3), slope, turn)
    floor, readings = on_ramp(FLOOR, slope, turn), on_ramp(lanes(heights), slope, turn)
    found = found_of(np.concatenate([floor, steel]), readings)
    beside = np.abs(readings[:, 0] - 3.0) < 0.3
    lowest = readings[beside, 2].max() - np.ptp(heights)  # of the lowest pass, where it is highest
    whole = {v for v in voxels_of(steel) if (v[2] + 0.5) * VOXELS.edge >= lowest - VOXELS.below}
    assert whole <= found
    assert {v[:2] for v in found} == {v[:2] for v in whole}


@LEVEL_OR_NOT
def test_a_low_beam_between_the_heights_of_a_survey_is_kept(slope: float, turn: float) -> None:
    """Above the lowest pass, below the others; the floor is seen under it."""
    beam = on_ramp(lattice((1.0, 1.0), (5.0, 1.1), 0.58), slope, turn)
    floor, readings = on_ramp(FLOOR, slope, turn), on_ramp(lanes(PASSES), slope, turn)
    found = found_of(np.concatenate([floor, beam]), readings)
    assert voxels_of(beam) <= found
    assert {v[:2] for v in found} == {v[:2] for v in voxels_of(beam)}


def test_a_guard_rail_a_hand_over_the_lowest_sensors_is_kept() -> None:
    rail = np.concatenate([lattice((1.0, 1.0), (5.0, 1.1), z) for z in (0.1, 0.2, 0.3)])
    assert voxels_of(rail) <= found_of(np.concatenate([FLOOR, rail]), lanes((0.2,)))


def test_a_shelf_that_hides_its_floor_is_kept() -> None:
    """The floor in front of it is lower than any ramp could lead to it from there."""
    shelf = lattice((1.0, 0.7), (5.0, 1.6), 0.8)
    seen = FLOOR[FLOOR[:, 1] < 0.7]
    assert voxels_of(shelf) <= found_of(np.concatenate([seen, shelf]), lanes((0.4,)))


def test_a_high_beam_in_a_cloud_without_floor_is_kept() -> None:
    """The readings tell that it is none."""
    beam = lattice((1.0, 1.0), (5.0, 1.1), 1.4)
    assert voxels_of(beam) <= found_of(beam, lanes(PASSES))

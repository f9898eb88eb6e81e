from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.maps.harmonic import compiled, compiled_tile, harmonic_map, potential_grid
from l2m_gtsam.maps.harmonic.basis import Basis
from l2m_gtsam.maps.harmonic.compiled_tile import CompiledTile, compile_tile
from l2m_gtsam.maps.harmonic.evidence import Weights
from l2m_gtsam.maps.harmonic.family import Hyperparameters, UniformField
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap, HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.places import AlongX, Places
from l2m_gtsam.maps.harmonic.tiles import Tile
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.harmonic.triangular import TriangularFactor
from l2m_gtsam.simulate.hall_drives import survey
from l2m_gtsam.simulate.steel_hall import STRONG, steel_hall
from tests.worlds.exact import dipole_world

OVER = np.array([0.0, 0.0, 4.0])  # metres: from the drive to where no reading is near
FIELD_TOLERANCE, GRADIENT_TOLERANCE = 0.005, 0.02  # uT and uT/m: what the map promises

# Given, so that nothing has to be learnt; few modes make small tiles, so that several blend.
PRIOR = Hyperparameters(
    floor_scale=3.0,
    floor_depth=0.7,
    ceiling_scale=1.5,
    ceiling_depth=1.2,
    structure_scale=0.1,
    noise=0.2,
)
OPTIONS = HarmonicOptions.model_validate(
    {"hyperparameters": PRIOR, "modes": 350, "search": {"rounds": 0}}
)


@cache
def dipoles(tilt: float = 0.0) -> HarmonicMap:
    """Return the map of a dipole world, surveyed in three planes that may be tilted."""
    rng = np.random.default_rng(3)
    local = rng.uniform([-2.5, -2.5, 0], [2.5, 2.5, 0], (900, 3))
    local[:, 2] = rng.choice([0.4, 0.5, 0.6], 900)
    R = Rotation.from_euler("x", tilt).as_matrix()
    field, _ = dipole_world(1).field_and_gradient(local)
    noise = rng.normal(0, 0.2, field.shape)
    return HarmonicMap.fit(local @ R.T, (field + noise) @ R.T, OPTIONS)


@cache
def hall() -> HarmonicMap:
    """Return the map of a hall with strong posts that a LiDAR saw."""
    world = steel_hall(3, STRONG, posts=3, racks=0)
    data = survey(world, 3, count=600)
    cloud = world.cloud()
    return HarmonicMap.fit(data.points, data.field, OPTIONS, cloud)


MAPS: dict[str, Callable[[], HarmonicMap]] = {
    "dipoles": dipoles,
    "tilted": lambda: dipoles(0.25),
    "hall": hall,
}


@dataclass(frozen=True)
class Case:
    exact: HarmonicMap
    compiled: CompiledMap


@pytest.fixture(scope="module", params=list(MAPS))
def case(request: pytest.FixtureRequest) -> Case:
    exact = MAPS[request.param]()
    return Case(exact, exact.compile())


def near(exact: HarmonicMap, count: int, seed: int = 7) -> FloatArray:
    """Return places up to the map's reach away from readings."""
    rng = np.random.default_rng(seed)
    readings = exact.learnt.readings.points
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    away = exact.options.reach * rng.uniform(0, 1, (count, 1)) ** (1 / 3)
    return np.asarray(readings[rng.integers(0, len(readings), count)] + away * direction)


def assert_same(exact: FieldMap, other: FieldMap, points: FloatArray) -> None:
    for one, two in zip(
        exact.field_and_gradient(points), other.field_and_gradient(points), strict=True
    ):
        # Sums over batches of another size differ by rounding.
        np.testing.assert_allclose(two, one, rtol=1e-9, atol=1e-9)


def test_the_error_is_within_what_is_promised(case: Case) -> None:
    points = near(case.exact, 800)
    field, gradient = case.compiled.field_and_gradient(points)
    true_field, true_gradient = case.exact.field_and_gradient(points)
    assert np.abs(field - true_field).max() < FIELD_TOLERANCE
    assert np.abs(gradient - true_gradient).max() < GRADIENT_TOLERANCE
    # It was the grids that answered.
    assert np.abs(field - true_field).max() > 1e-7
    for visit in case.exact.learnt.tiling.by_tile(points):
        tile = case.compiled.compiled.tile(visit.tile)
        assert isinstance(tile, CompiledTile)
        local = tile.frame.localise(points[visit.rows])
        assert np.isfinite(tile.grid.field_and_gradient(local)[0]).all()


def test_the_worlds_are_what_they_are_meant_to_be() -> None:
    frames = [tile.basis.frame for tile in dipoles(0.25).tiles]
    assert any(np.abs(frame.R_map_tile - np.eye(3)).max() > 0.1 for frame in frames)
    assert all(len(MAPS[name]().tiles) > 3 for name in MAPS)
    sources = [len(compiled_tile.sources_of(tile)) for tile in hall().tiles]
    assert max(sources) > 100


def test_the_gradient_is_symmetric_and_without_trace(case: Case) -> None:
    _, gradient = case.compiled.field_and_gradient(near(case.exact, 500))
    # Turning into a tilted frame rounds.
    scale = np.abs(gradient).max(axis=(1, 2), keepdims=True)
    assert (np.abs(gradient - gradient.transpose(0, 2, 1)) <= 1e-12 * scale).all()
    trace = np.trace(gradient, axis1=1, axis2=2)
    assert np.abs(trace).max() < 3 * GRADIENT_TOLERANCE  # three components, each so far off


def test_away_from_data_the_exact_map_answers(case: Case) -> None:
    rng = np.random.default_rng(5)
    angle = rng.uniform(-np.pi, np.pi, 40)
    aside = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(40)])
    far = aside * rng.uniform(8, 30, (40, 1))
    assert_same(case.exact, case.compiled, far)
    above = case.exact.learnt.readings.points[:40] + OVER
    assert_same(case.exact, case.compiled, above)


def test_a_mixture_of_places_is_answered_in_order(case: Case) -> None:
    points = np.concatenate([near(case.exact, 20), near(case.exact, 20) + OVER])
    points = points[np.random.default_rng(0).permutation(40)]
    field, gradient = case.compiled.field_and_gradient(points)
    for n in range(40):
        alone = case.compiled.field_and_gradient(points[n : n + 1])
        np.testing.assert_allclose(field[n], alone[0][0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(gradient[n], alone[1][0], rtol=1e-9, atol=1e-9)


def test_threads_change_nothing(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    points = near(case.exact, 1000)
    monkeypatch.setattr(harmonic_map, "SERIAL", 10**9)
    one = case.compiled.field_and_gradient(points)
    monkeypatch.setattr(harmonic_map, "SERIAL", 0)
    monkeypatch.setattr(harmonic_map, "PIECE", 100)
    two = case.compiled.field_and_gradient(points)
    # Products of matrices round otherwise for other numbers of rows.
    np.testing.assert_allclose(one[0], two[0], rtol=1e-12)
    np.testing.assert_allclose(one[1], two[1], rtol=1e-9, atol=1e-9)


def test_all_but_the_field_is_that_of_the_exact_map(case: Case) -> None:
    points = np.concatenate([near(case.exact, 30), near(case.exact, 3) + 50.0])
    mine, exact = case.compiled.query(points), case.exact.query(points)
    np.testing.assert_array_equal(mine.variance, exact.variance)
    np.testing.assert_array_equal(mine.inside, exact.inside)
    assert mine.inside.any()
    assert not mine.inside.all()
    np.testing.assert_allclose(mine.field, exact.field, rtol=0, atol=FIELD_TOLERANCE)
    np.testing.assert_allclose(mine.gradient, exact.gradient, rtol=0, atol=GRADIENT_TOLERANCE)
    np.testing.assert_array_equal(case.compiled.variance(points), case.exact.variance(points))
    assert case.compiled.kind == case.exact.kind
    assert case.compiled.summary.facts == case.exact.summary.facts
    state, other = case.compiled.to_state(), case.exact.to_state()
    assert state.options == other.options
    np.testing.assert_array_equal(state.arrays["points"], other.arrays["points"])


def test_new_readings_are_in_the_compiled_map() -> None:
    exact = dipoles()
    fast: FieldMap = exact.compile()
    points = exact.learnt.readings.points[:50] + 0.03
    field, _ = dipole_world(1).field_and_gradient(points)
    found = fast.updated(points, field + 1.0).field_and_gradient(points)
    expected = exact.updated(points, field + 1.0).field_and_gradient(points)
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=FIELD_TOLERANCE)
    assert np.abs(expected[0] - exact.field_and_gradient(points)[0]).max() > 0.1


def test_solvers_share_compiled_tiles() -> None:
    """A second calibration on a map compiles nothing again."""
    exact = replace(dipoles())
    points = near(exact, 50)
    exact.compile().field_and_gradient(points)
    before = dict(exact.compile().compiled.made)
    assert before
    exact.compile().field_and_gradient(points)
    after = exact.compile().compiled.made
    assert {index: id(tile) for index, tile in after.items()} == {
        index: id(tile) for index, tile in before.items()
    }


def test_tiles_are_compiled_when_they_are_needed() -> None:
    exact = replace(dipoles())  # without compiled tiles
    fast = exact.compile()
    assert not fast.compiled.made
    points = near(exact, 200)
    points = points[points[:, 0] < points[:, 0].min() + 0.5]
    fast.field_and_gradient(points)
    visited = {visit.tile for visit in exact.learnt.tiling.by_tile(points)}
    assert set(fast.compiled.made) == visited
    assert len(visited) < len(exact.tiles)


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = replace(dipoles())
    fast, points = exact.compile(), near(exact, 300)
    expected = fast.field_and_gradient(points)
    assert len(fast.compiled.made) > 2
    sizes = [tile.nbytes for tile in fast.compiled.made.values() if isinstance(tile, CompiledTile)]
    monkeypatch.setattr(compiled, "MEMORY", 2 * max(sizes))
    again = replace(exact).compile()
    found = again.field_and_gradient(points)
    np.testing.assert_array_equal(found[0], expected[0])
    kept = [tile.nbytes for tile in again.compiled.made.values() if isinstance(tile, CompiledTile)]
    assert 0 < sum(kept) <= 2 * max(sizes)
    last = exact.learnt.tiling.by_tile(points)[-1].tile
    assert last in again.compiled.made


@pytest.mark.parametrize(
    ("module", "limit", "value"),
    [(compiled_tile, "GRADIENT_TOLERANCE", 1e-30), (potential_grid, "MOST_NODES", 1000)],
)
def test_where_no_grid_is_good_enough_the_exact_tile_answers(
    module: object, limit: str, value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, limit, value)
    exact = replace(dipoles())
    fast, points = exact.compile(), near(exact, 50)
    assert_same(exact, fast, points)
    assert list(fast.compiled.made.values()) == [exact.tiles[i] for i in fast.compiled.made]


def test_a_grid_that_errs_is_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled_tile, "WAVE", 2.0)  # far too coarse
    exact = replace(dipoles())
    fast, points = exact.compile(), near(exact, 500)
    field, _ = fast.field_and_gradient(points)
    true_field, _ = exact.field_and_gradient(points)
    assert np.abs(field - true_field).max() < FIELD_TOLERANCE
    made = fast.compiled.made
    tiles = [tile for tile in made.values() if isinstance(tile, CompiledTile)]
    assert tiles
    solved = exact.tiles[next(iter(made))]
    coarse = compiled_tile.fineness_for(solved, compiled_tile.sources_of(solved))
    assert max(tile.grid.spacing for tile in tiles) < coarse.spacing


def plain_tile() -> Tile:
    """Return a tile that knows a uniform field and nothing else."""
    frame = TileFrame(np.eye(3), np.zeros(3), np.array([4.0, 4.0]), 1.0)
    factor = TriangularFactor.of(np.eye(3))
    weights = Weights(np.array([20.0, -3.0, 40.0]), np.ones(3), factor)
    return Tile(Basis(frame, (UniformField(100.0),)), weights, PRIOR, Resolution(0.5, 0.5))


def test_a_tile_without_waves_and_sources_is_compiled_too() -> None:
    readings = np.random.default_rng(0).uniform(0, 4, (50, 3))
    tile = compile_tile(plain_tile(), Places.around(AlongX.of(readings), 0.5, np.full(2, 2.0), 2.0))
    assert isinstance(tile, CompiledTile)
    field, gradient = tile.field_and_gradient(readings)
    # Rounding, 1e-16, of a potential of some 1000 uT m on a wide grid, some ten times over in the
    # filter, over the spacing of 2 m or its square.
    np.testing.assert_allclose(field, np.tile([20.0, -3.0, 40.0], (50, 1)), rtol=0, atol=1e-10)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-10)


@pytest.mark.parametrize("where", [[50.0, 50.0, 0.0], [4.4999999, 4.4999999, 0.5]])
def test_a_tile_with_hardly_a_reading_nearby_stays_as_it_is(where: list[float]) -> None:
    tile = plain_tile()
    assert (
        compile_tile(tile, Places.around(AlongX.of(np.array([where])), 0.5, np.full(2, 2.0), 2.0))
        is tile
    )

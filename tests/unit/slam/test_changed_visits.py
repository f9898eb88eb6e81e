"""A visit of a tile: whether its poses are off or the field has changed."""

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.hyperparameters import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.slam.options import TileOptions
from l2m_gtsam.slam.unknown_field.changed_visits import (
    CLEAR,
    LIKELY,
    Seen,
    change_gain,
    fitted,
)
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, WaveTile
from tests.worlds.exact import DipoleWorld, dipole_world

NOISE = 0.2
PRIOR = FieldPrior(
    Hyperparameters(
        floor_scale=4.0, floor_depth=0.8, ceiling_scale=2.0, ceiling_depth=1.5, noise=NOISE
    ),
    Resolution(6.0, 4.0),
    TileOptions(),
)


def line(rng: np.random.Generator, count: int = 50) -> FloatArray:
    """Readings along a way through the tile, at two heights, shape (2 count, 3)."""
    x = np.linspace(-1.4, 1.4, count)
    side, angle = rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)
    way = np.column_stack([x, side + angle * x, 0.4 + 0.02 * np.sin(5 * x)])
    return np.concatenate([way, way + np.array([0.05, 0.2, 0.15])])


def seen(world: DipoleWorld, points: FloatArray, rng: np.random.Generator) -> Seen:
    field = world.field_and_gradient(points)[0]
    noise = rng.normal(0, NOISE, field.shape)
    return Seen(points, field + noise, np.full(field.shape, NOISE**2))


def gains(seed: int, steel: float) -> tuple[float, float]:
    """Return the gains of a visit whose poses are off, and of one with steel besides."""
    rng, world = np.random.default_rng(seed), dipole_world(seed)
    earlier = seen(world, np.concatenate([line(rng), line(rng)]), rng)
    way = line(rng)
    at = np.array([[0.5, 1.6, 0.5]])
    other = DipoleWorld(
        world.uniform,
        np.vstack([world.positions, at]),
        np.vstack([world.moments, steel * np.array([[1.0, -0.5, 0.7]])]),
    )
    found = []
    R = Rotation.from_rotvec([0.01, -0.01, 0.04]).as_matrix()
    tile = WaveTile.about(PRIOR, np.eye(3), np.concatenate([earlier.points, way]))
    for place in (world, other):
        visit = seen(place, way, rng)
        # The vehicle believes to be 15 cm and 2 degrees elsewhere.
        off = Seen(way @ R.T + [0.1, -0.1, 0.02], visit.field @ R.T, visit.variance)
        found.append(change_gain(tile, earlier, off))
    return found[0], found[1]


def test_steel_is_told_from_poses_that_are_off() -> None:
    """30 A m2 at 1.6 m from the middle of a tile make about 2 uT; poses are off by 15 cm."""
    found = np.array([gains(seed, 30.0) for seed in range(3)])
    assert (found[:, 0] < LIKELY).all()
    assert (found[:, 1] > CLEAR).all()


def test_derivatives_by_the_motion() -> None:
    rng, world = np.random.default_rng(3), dipole_world(3)
    visit = seen(world, line(rng, 10), rng)
    tile = WaveTile.about(PRIOR, np.eye(3), visit.points)
    mean = rng.normal(size=len(tile))
    here, step = np.zeros(6), 1e-6
    D = fitted(tile, mean, visit, here).D
    for k in range(6):
        ahead, back = (
            fitted(tile, mean, visit, here + sign * step * np.eye(6)[k]).left for sign in (1, -1)
        )
        np.testing.assert_allclose((ahead - back) / (2 * step), -D[:, k], atol=1e-4)

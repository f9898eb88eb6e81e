"""A visit of a tile: whether its poses are off or the field has changed."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.slam.options import TileOptions
from l2m_gtsam.slam.unknown_field.changed_visits import (
    MOTION,
    EarlierField,
    Remembered,
    Seen,
    VisitResiduals,
)
from l2m_gtsam.slam.unknown_field.revisited_tiles import moved_steel
from l2m_gtsam.slam.unknown_field.tile_visits import CLEAR, LIKELY, JudgedVisits, Visit
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, WaveTile
from l2m_gtsam.slam.unknown_field.visit_graph import VisitGraph, Way
from tests.worlds.exact import DipoleWorld, dipole_world

NOISE = 0.2
PRIOR = FieldPrior(
    Hyperparameters(
        floor_scale=4.0, floor_depth=0.8, ceiling_scale=2.0, ceiling_depth=1.5, noise=NOISE
    ),
    Resolution(6.0, 4.0),
    TileOptions(),
)


def line(rng: np.random.Generator, count: int = 40) -> FloatArray:
    """Readings along a way through the tile, at two heights, shape (2 count, 3)."""
    x = np.linspace(-1.4, 1.4, count)
    side, angle = rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)
    way = np.column_stack([x, side + angle * x, 0.4 + 0.02 * np.sin(5 * x)])
    return np.stack([way, way + np.array([0.05, 0.2, 0.15])], axis=1).reshape(-1, 3)


AT, MOMENT = np.array([0.5, 1.6, 0.5]), np.array([30.0, -15.0, 21.0])
FIRST, LATER = np.arange(10), np.arange(100, 110)  # key poses of the visits
TURN, SHIFT = np.array([0.01, -0.01, 0.04]), np.array([0.1, -0.1, 0.02])
WAY = Way(gtsam.Pose3(), np.diag(MOTION**2), np.zeros((2, 3)), np.zeros((6, 2)))


def seen(world: DipoleWorld, points: FloatArray, rng: np.random.Generator, first: int) -> Seen:
    field = world.field_and_gradient(points)[0]
    noise = rng.normal(0, NOISE, field.shape)
    key_pose = first + 10 * np.arange(len(points)) // len(points)
    return Seen(points, field + noise, np.full(field.shape, NOISE**2), key_pose)


def visits(seed: int, share: float, off: float = 1.0) -> list[Visit]:
    """Two visits; steel comes when this share of the second one is over.

    The vehicle believes to be 15 cm and 2 degrees elsewhere in the second, times ``off``.
    """
    rng, world = np.random.default_rng(seed), dipole_world(seed)
    ways = np.concatenate([line(rng), line(rng)])
    earlier, way = seen(world, ways, rng, 0), line(rng)
    clean = seen(world, way, rng, 100)
    brought = (
        world.with_dipoles(AT, MOMENT).field_and_gradient(way)[0] - world.field_and_gradient(way)[0]
    )
    come = np.arange(len(way)) >= share * len(way)
    R = Rotation.from_rotvec(off * TURN).as_matrix()
    field = (clean.field + brought * come[:, None]) @ R.T
    later = replace(clean, points=way @ R.T + off * SHIFT, field=field)
    tile = WaveTile.about(PRIOR, np.eye(3), np.concatenate([earlier.points, later.points]))
    node = gtsam.Pose3()
    return [Visit(0, FIRST, tile, node, earlier), Visit(0, LATER, tile, node, later)]


def judged(found: list[Visit], way: Way = WAY) -> JudgedVisits:
    return JudgedVisits.of(found, VisitGraph((gtsam.Pose3(),) * 2, (way,)), frozenset())


@pytest.mark.parametrize("seed", range(2))
def test_steel_is_told_from_poses_that_are_off(seed: int) -> None:
    """39 A m2 at 1.6 m from the middle of a tile make about 2 uT; poses are off by 15 cm."""
    still, moved = (judged(visits(seed, share)) for share in (1.0, 0.0))
    assert still.visits[1].gain < LIKELY
    assert still.first_change() is None
    assert moved.visits[1].gain > CLEAR
    change = moved.first_change()
    assert change is not None
    assert (change.begin, change.end) == (FIRST[5], LATER[5])
    assert moved.cut(change) is None


@pytest.mark.parametrize("seed", range(2))
def test_a_visit_is_cut_where_steel_came_meanwhile(seed: int) -> None:
    found = judged(visits(seed, 0.5))
    change = found.first_change()
    assert change is not None
    cut = found.cut(change)
    assert cut is not None
    assert abs(cut - LATER[5]) <= 1
    early, late = visits(seed, 0.5)[1].parts(cut)
    assert early.key_poses[-1] == cut - 1
    assert late.begun == cut
    assert early.seen.key_pose.max() < cut - 1 < cut < late.seen.key_pose.min()


def test_where_it_was_is_found_again() -> None:
    """Of 14 cm and 2.4 degrees 4 cm are left, as one line of readings of 0.2 uT determines it."""
    R = gtsam.Rot3(Rotation.from_rotvec(TURN).as_matrix())
    left = judged(visits(1, 1.0)).graph.nodes[1].compose(gtsam.Pose3(R, SHIFT))
    assert np.linalg.norm(left.translation()) < 0.4 * np.linalg.norm(SHIFT)
    assert np.linalg.norm(gtsam.Rot3.Logmap(left.rotation())) < 0.4 * np.linalg.norm(TURN)


@pytest.mark.parametrize("seed", range(2))
def test_what_came_is_found(seed: int) -> None:
    """From one side, 0.8 m and more away: within its sigmas, which are a tenth of that."""
    known = replace(WAY, covariance=(0.05 * np.diag(MOTION)) ** 2)
    found = judged(visits(seed, 0.0, off=0.0), known)
    change = found.first_change()
    assert change is not None
    moved = moved_steel(found, change)
    (source,) = moved.sources.shapes
    e = np.concatenate([source.position - AT, source.moment - MOMENT])
    P = moved.sources.covariance[:6, :6]
    assert e @ np.linalg.solve(P, e) < 22.5  # chi squared of 6, once in 1,000
    assert np.sqrt(np.diag(P)[:3]).max() < 0.2
    assert moved.sigma(AT + np.array([[0.0, 6.0, 0.0]])) < 0.02


def test_derivatives_by_the_motion() -> None:
    rng = np.random.default_rng(3)
    first, visit = visits(3, 1.0)
    node = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 1.0), np.array([0.4, 0.1, 0.2]))
    visit = replace(visit, T_anchor_node=node)
    known = EarlierField.of(Remembered(np.eye(len(first.field)), rng.normal(size=len(first.field))))

    def left(motion: FloatArray) -> FloatArray:
        moved = visit.at(node.retract(motion))
        own = VisitResiduals.of(visit.field, known, moved.seen, moved.T_anchor_node)
        return own.left

    D, step = VisitResiduals.of(visit.field, known, visit.seen, node).by_motion, 1e-6
    for k in range(6):
        ahead, back = (left(sign * step * np.eye(6)[k]) for sign in (1, -1))
        np.testing.assert_allclose((ahead - back) / (2 * step), -D[:, :, k], atol=1e-4)

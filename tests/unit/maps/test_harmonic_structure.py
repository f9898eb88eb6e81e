"""Sources that a cloud suggests: where they stand, their combinations, their strengths."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.harmonic import structure
from l2m_gtsam.maps.harmonic.basis import FINE, basis_of, dipoles_of
from l2m_gtsam.maps.harmonic.dipoles import moment_features
from l2m_gtsam.maps.harmonic.evidence import normal_of
from l2m_gtsam.maps.harmonic.frame import tile_frame
from l2m_gtsam.maps.harmonic.structure import (
    NO_SOURCES,
    SIGHT,
    Sources,
    StructureOptions,
    candidate_sources,
)
from l2m_gtsam.maps.harmonic.teaching import learn_map, learn_strengths
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.training import TrainingSet, training_set
from tests.reference.potentials import features
from tests.worlds.harmonic import GIVEN, OPTIONS

DRIVE = np.column_stack(
    [np.linspace(0, 6, 120), np.zeros(120), np.where(np.arange(120) % 2, 0.4, 0.8)]
)
VOXELS = StructureOptions()


def column(x: float, y: float, low: float, high: float) -> FloatArray:
    z = np.arange(low, high, 0.05)
    return np.column_stack([np.full(len(z), x), np.full(len(z), y), z])


def floor_points() -> FloatArray:
    x, y = np.meshgrid(np.arange(-1, 7, 0.1), np.arange(-1.5, 1.5, 0.1))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def test_a_bare_floor_makes_no_sources() -> None:
    assert len(candidate_sources(floor_points(), DRIVE, VOXELS)) == 0


def test_no_cloud_makes_no_sources() -> None:
    assert len(candidate_sources(np.empty((0, 3)), DRIVE, VOXELS)) == 0


def test_a_post_makes_sources_along_itself() -> None:
    post = column(3.0, 0.7, 0.0, 1.5)
    found = candidate_sources(np.concatenate([floor_points(), post]), DRIVE, VOXELS)
    half = VOXELS.edge / 2
    assert (np.abs(found.positions[:, :2] - [3.0, 0.7]) <= half + 1e-9).all()
    # From half a metre below the lowest reading, here the floor, to its top: one per voxel.
    occupied = np.unique(np.floor(post[:, 2] / VOXELS.edge))
    occupied = occupied[(occupied + 0.5) * VOXELS.edge >= 0.4 - VOXELS.below]
    assert len(found) == len(occupied)
    assert (found.structure == 0).all()


def test_structure_under_the_drive_is_followed_only_so_far() -> None:
    deep = candidate_sources(column(3.0, 0.7, -1.5, 1.5), DRIVE, VOXELS)
    assert deep.positions[:, 2].min() >= 0.4 - VOXELS.below
    assert deep.positions[:, 2].min() < 0.4 - VOXELS.below + VOXELS.edge


def test_structure_below_the_drive_alone_is_the_floors() -> None:
    assert len(candidate_sources(column(3.0, 0.7, 0.0, 0.3), DRIVE, VOXELS)) == 0


def test_no_source_is_out_of_reach_or_where_the_sensor_was() -> None:
    rng = np.random.default_rng(7)
    cloud = rng.uniform([-4, -4, -1], [10, 4, 4], (20_000, 3))
    found = candidate_sources(cloud, DRIVE, VOXELS)
    away = np.linalg.norm(found.positions[:, None] - DRIVE, axis=2).min(axis=1)
    assert len(found) > 100
    assert away.max() <= VOXELS.reach
    assert away.min() >= VOXELS.clearance


def test_pieces_are_touching_voxels_of_one_cell() -> None:
    wall = np.concatenate([column(x, 0.7, 0.2, 1.2) for x in np.arange(0.06, 3.9, 0.05)])
    lone = column(5.5, -0.7, 0.2, 1.2)
    found = candidate_sources(np.concatenate([wall, lone]), DRIVE, VOXELS)
    parts = found.pieces
    assert sum(len(part) for part in parts) == len(found)
    assert len(parts) == 5  # four metres of wall and a post
    for part in parts:
        assert len(np.unique(part.structure)) == 1
        assert (np.ptp(part.positions[:, :2], axis=0) <= VOXELS.piece).all()
    np.testing.assert_array_equal(np.unique(found.structure), np.arange(5))


def test_two_posts_of_one_cell_are_two_structures() -> None:
    posts = np.concatenate([column(3.2, 0.7, 0.2, 1.2), column(3.7, 0.7, 0.2, 1.2)])
    assert len(candidate_sources(posts, DRIVE, VOXELS).pieces) == 2


def test_too_many_sources_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(structure, "MOST_SOURCES", 5)
    with pytest.raises(MapError, match=r"suggests 1\d sources .* at most 5 .* structure.edge"):
        candidate_sources(column(3.0, 0.7, 0.0, 1.5), DRIVE, VOXELS)


def test_structures_are_those_of_every_tile_they_stand_in_or_close_to() -> None:
    """By their middle, in the box or up to ``SIGHT`` beside it."""
    positions = np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.2, 0, 0]])
    sources = Sources(positions, np.array([0, 0, 1, 1]))
    assert sources.within(np.zeros(2), 1.2) == [0]
    assert sources.within(np.zeros(2), 2 * (3.1 - SIGHT) - 0.01) == [0]
    assert sources.within(np.zeros(2), 2 * (3.1 - SIGHT) + 0.01) == [0, 1]
    assert sources.within(np.array([9.0, 0.0]), 1.0) == []
    assert NO_SOURCES.within(np.zeros(2), 1.0) == []


def test_structure_that_no_tile_sees_has_no_strength() -> None:
    """Its middle is out of reach, though a voxel of it is not."""
    points = np.random.default_rng(0).uniform([0, 0, 0.2], [2, 2, 0.8], (400, 3))
    readings = training_set(points, np.random.default_rng(1).normal(0, 1, points.shape))
    far = Sources(np.array([[12.0, 1.0, 0.5]]), np.array([0]))
    assert learn_map(readings, far, OPTIONS).strengths == pytest.approx([0.0])


def sparse_post(x: float) -> FloatArray:
    """Six sources one above the other, 12 cm apart."""
    return np.column_stack([np.full(6, x), np.zeros(6), 0.2 + 0.12 * np.arange(6)])


def test_combinations_leave_out_only_what_no_reading_sees() -> None:
    """Sources 4 cm apart, seen from half a metre and more: fewer weights, the same field."""
    rng = np.random.default_rng(8)
    dense = column(0.0, 0.0, 0.2, 0.8)
    sources = Sources(dense, np.zeros(len(dense), dtype=np.int64))
    angle = rng.uniform(0, 2 * np.pi, 300)
    ring = rng.uniform(0.5, 1.5, 300) * np.stack([np.cos(angle), np.sin(angle)])
    points = np.column_stack([*ring, rng.uniform(0.2, 0.9, 300)])
    frame = tile_frame(points, np.zeros(2), 4.0)
    seen = dipoles_of(sources, training_set(points, np.zeros((300, 3))), frame, 1.5, FINE)
    count = 3 * len(dense)
    assert len(seen) < 0.8 * count
    gram = seen.combinations.T @ seen.combinations
    np.testing.assert_allclose(gram, np.eye(len(seen)), atol=1e-12)
    local, moments = frame.localise(points), rng.normal(size=count)
    field = moment_features(local, seen.positions) @ moments
    kept = features(seen, local) @ (seen.combinations.T @ moments)
    # Each combination that is left out holds less than FINE of the best one's energy, and the
    # best of so many holds more than its share of the field's.
    assert np.sum((field - kept) ** 2) < FINE * count**2 * np.sum(field**2)


def two_posts(moments: FloatArray) -> tuple[TrainingSet, Sources]:
    """Readings around two posts at x = -1 and 1, the first with moments (6, 3)."""
    rng = np.random.default_rng(9)
    posts = [sparse_post(x) for x in (-1.0, 1.0)]
    sources = Sources(np.concatenate(posts), np.repeat([0, 1], 6))
    points = rng.uniform([-2, -1.2, 0.3], [2, 1.2, 0.8], (900, 3))
    points = points[np.abs(points[:, 1]) > 0.3]
    field = moment_features(points, posts[0]) @ moments.ravel()
    return training_set(points, field + rng.normal(0, GIVEN.noise, points.shape)), sources


def learnt_strengths(readings: TrainingSet, sources: Sources) -> list[float]:
    resolution = Resolution(3.0, 2.0)
    quiet = GIVEN.model_copy(update={"floor_scale": 0.1, "ceiling_scale": 0.1})
    model = basis_of(readings, np.zeros(2), 5.0, resolution, sources.pieces, np.ones(2))
    return learn_strengths(model, normal_of(model, readings), quiet)


def test_only_structures_with_a_field_have_strength() -> None:
    moments = np.random.default_rng(10).normal(0, 0.8, (6, 3))
    steel, timber = learnt_strengths(*two_posts(moments))
    # The prior scale is 0.4: strength 2 for moments of 0.8; the three or so combinations that
    # readings determine well say it within a factor of two or three.
    assert 0.6 < steel < 6
    assert timber == 0.0


def test_no_field_no_strength() -> None:
    assert learnt_strengths(*two_posts(np.zeros((6, 3)))) == [0.0, 0.0]


def test_strengths_do_not_depend_on_where_the_search_starts() -> None:
    readings, sources = two_posts(np.random.default_rng(11).normal(0, 0.5, (6, 3)))
    model = basis_of(
        readings, np.zeros(2), 5.0, Resolution(3.0, 2.0), sources.pieces, np.full(2, 0.2)
    )
    quiet = GIVEN.model_copy(update={"floor_scale": 0.1, "ceiling_scale": 0.1})
    elsewhere = learn_strengths(model, normal_of(model, readings), quiet)
    here = learnt_strengths(readings, sources)
    # Both searches end where the likelihood is flat to 1e-9 of itself.
    np.testing.assert_allclose(elsewhere, here, rtol=0.02)

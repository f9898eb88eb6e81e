"""A patch of strong steel that a survey's evenly spread windows do not show."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.tiling import rough_tiles, roughness
from l2m_gtsam.maps.training import training_set
from tests.worlds.exact import DipoleWorld
from tests.worlds.harmonic import NO_SEARCH, OPTIONS, WORLD, readings

NOISE = 0.1
PATCH = (np.array([12.0, 0.5, 0.3]), np.array([15.0, 3.5, 0.7]))


def hall() -> DipoleWorld:
    """Return deep weak sources under thirty metres, and shallow strong ones under three."""
    rng = np.random.default_rng(0)
    deep = rng.uniform([0, -1, -1.6], [30, 5, -1.0], (300, 3))
    moments = rng.normal(0, 0.3, (300, 3))
    shallow = rng.uniform([12, 0.5, -0.25], [15, 3.5, -0.05], (120, 3))
    strong = rng.normal(0, 0.6, (120, 3))
    sources, all_moments = np.vstack([deep, shallow]), np.vstack([moments, strong])
    return DipoleWorld(np.array([20.0, 0.0, -40.0]), sources, all_moments)


def survey(world: DipoleWorld) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(1)
    points = rng.uniform([0, 0, 0.2], [30, 4, 0.8], (8_000, 3))
    return points, world.field_and_gradient(points)[0] + rng.normal(0, NOISE, points.shape)


def test_a_patch_between_the_windows_is_mapped_as_well_as_the_rest() -> None:
    """With the windows spread alone errors in the patch were seven times their sigmas."""
    world = hall()
    ours = HarmonicMap.fit(*survey(world), HarmonicOptions(search=NO_SEARCH))
    at = np.random.default_rng(2).uniform(*PATCH, (600, 3))
    sample = ours.query(at)
    z = (sample.field - world.field_and_gradient(at)[0]) / np.sqrt(sample.variance)
    assert sample.inside.all()
    # One patch of a few independent square metres: the figure is known to about a fifth.
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3
    assert ours.summary.doubts == ()


def test_rough_tiles_are_those_over_the_patch() -> None:
    points, field = survey(hall())
    few = slice(None, None, 10)
    ours = HarmonicMap.fit(points[few], field[few], OPTIONS)
    learnt = ours.learnt
    tiles = rough_tiles(learnt.readings, learnt.members, 3, besides=())
    east = learnt.tiling.grid.centres[tiles, 0]
    assert ((east > 11) & (east < 16)).all()
    assert not set(tiles) & set(rough_tiles(learnt.readings, learnt.members, 3, besides=tiles))


def test_a_linear_field_is_not_rough() -> None:
    points, _ = readings(100)
    linear = np.array([20.0, 0.0, -40.0]) + points @ np.diag([1.0, 2.0, -3.0])
    assert roughness(training_set(points, linear)) == pytest.approx(0.0, abs=1e-9)
    noisy = linear + np.random.default_rng(0).normal(0, 0.5, linear.shape)
    assert roughness(training_set(points, noisy)) == pytest.approx(0.5, rel=0.2)


def test_steel_that_one_region_hides_is_told() -> None:
    """Strong steel in one corner that the fixed prior does not allow for."""
    points, field = readings(2000, east=0.0)
    far = points + np.array([6.0, 0.0, 0.0])
    quiet = WORLD.field_and_gradient(far)[0] + np.random.default_rng(3).normal(0, 0.2, far.shape)
    ours = HarmonicMap.fit(np.vstack([points, far]), np.vstack([field, quiet]), OPTIONS)
    assert ours.learnt.origin.explanation.worst > ours.learnt.origin.explanation.spread
    assert any("does not explain the field" in each for each in ours.summary.doubts)


def test_one_small_place_is_not_judged() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0, 0.2], [0.45, 0.45, 0.8], (200, 3))
    field = WORLD.field_and_gradient(points)[0] + rng.normal(0, 0.2, points.shape)
    ours = HarmonicMap.fit(points, field, OPTIONS)
    assert not ours.learnt.origin.explanation.judged
    assert ours.summary.facts["field"] == "too few places to hold any out"
    assert any("too few places" in each for each in ours.summary.doubts)


def test_two_halls_are_two_parts() -> None:
    points, field = readings()
    far = points + np.array([40.0, 0.0, 0.0])
    ours = HarmonicMap.fit(np.vstack([points, far]), np.vstack([field, field]), OPTIONS)
    assert any("2 separate parts" in each for each in ours.summary.doubts)


def test_halls_a_hundred_kilometres_apart_take_no_more_memory() -> None:
    points, field = readings()
    far = points + np.array([1e5, -1e5, 0.0])
    ours = HarmonicMap.fit(np.vstack([points, far]), np.vstack([field, field]), OPTIONS)
    assert ours.learnt.tiling.parts == 2


def test_a_straight_drive_that_is_added_is_no_survey_on_one_line() -> None:
    points, field = readings()
    ours = HarmonicMap.fit(points, field, OPTIONS)
    assert not any(
        "on one line" in each for each in ours.updated(points[:1], field[:1]).summary.doubts
    )
    line = points * np.array([10.0, 0.02, 0.0])
    alone = HarmonicMap.fit(line, WORLD.field_and_gradient(line)[0], OPTIONS)
    assert any("on one line" in each for each in alone.summary.doubts)


def test_readings_that_are_added_are_judged() -> None:
    """A post that the first survey did not pass makes the verdict another."""
    points, _ = readings(1500, east=6.0)
    quiet = WORLD.field_and_gradient(points)[0]
    quiet = quiet + np.random.default_rng(4).normal(0, 0.2, quiet.shape)
    first = HarmonicMap.fit(points, quiet, OPTIONS)
    assert not first.learnt.origin.explanation.reasons
    later = first.updated(*readings(1500, east=0.0))
    assert later.learnt.origin.explanation.reasons
    assert any("does not explain the field" in each for each in later.summary.doubts)

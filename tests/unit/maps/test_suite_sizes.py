"""What errors of a survey's sensors are made of, and what exact sensors look like."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions
from l2m_gtsam.maps.harmonic.suite_sizes import SuiteSizes, stated_modes, tile_view
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.suite_errors import SHIFT, SIZE, SuiteErrors
from l2m_gtsam.solve.variance_components import WeightSystem

SCALES = np.array([1e-3, 5e-3, 0.3])  # metres, entries of C, uT


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9))
def test_modes_make_the_covariance_and_judged_ones_move_what_is_judged_alone(
    seed: int, size: int, rank: int
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.choice(SCALES, size)[:, None] * rng.normal(size=(size, rank))
    covariance, judged = root @ root.T, rng.random(size) < 0.5
    found = stated_modes(covariance, judged)
    sigma = np.sqrt(np.diag(covariance))
    scaled = found.root / sigma[:, None]
    # Directions of less than 1e-9 of a variance count as none.
    np.testing.assert_allclose(
        scaled @ scaled.T, covariance / np.outer(sigma, sigma), atol=1e-7 * size
    )
    assert found.root.shape[1] == len(found.judged) <= min(size, rank)
    assert not found.root[np.ix_(~judged, found.judged)].any()


def test_a_doubt_states_the_clocks_as_well() -> None:
    """A late clock alone looks like sensors that are off by millimetres."""
    doubt = SuiteSizes(t_m=0.0241, C=0.0021, H_ut=0.069, offset_s=0.0585).doubt
    assert "24.1 mm, 0.21% of the field, 0.069 uT and 58 ms each" in doubt


def test_without_anything_to_judge_there_are_no_such_modes() -> None:
    found = stated_modes(np.diag([1.0, 4.0]), np.zeros(2, dtype=np.bool_))
    np.testing.assert_allclose(np.abs(found.root).sum(axis=1), [1.0, 2.0])
    assert not found.judged.any()


COUNT, SENSORS = 300, 2
PLAIN = HarmonicOptions.model_validate(
    {
        "hyperparameters": {"floor_scale": 5.0, "floor_depth": 0.3, "noise": 0.2},
        "modes": 200,
        "search": {"rounds": 0},
    }
)


@pytest.fixture(scope="module")
def two_heights() -> HarmonicMap:
    """The map of two sensors, one above the other, whose prior is known."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1.2, (COUNT, 3))
    points[:, 2] = np.where(np.arange(COUNT) % SENSORS, 0.8, 0.1)
    return HarmonicMap.fit(points, rng.normal(0, 0.2, (COUNT, 3)), PLAIN)


def fullest(ours: HarmonicMap) -> int:
    """Return the tile with the most readings in its core."""
    owner = ours.learnt.tiling.grid.block_of(ours.readings.points)
    return int(np.bincount(owner).argmax())


def heights_of(count: int) -> SuiteErrors:
    """Return errors of the heights of sensors that take readings in turn."""
    shift = np.zeros((count, SHIFT, SIZE))
    shift[:, 2, 2] = 1.0
    every = np.arange(count)
    names = tuple(f"s{each}" for each in range(SENSORS))
    return SuiteErrors(names, np.zeros((SIZE * SENSORS,) * 2), every, every % SENSORS, shift)


def test_the_gradient_hangs_on_the_field_as_the_variance_slopes(two_heights: HarmonicMap) -> None:
    index = fullest(two_heights)
    tile, rows = two_heights.tiles[index], two_heights.learnt.members[index]
    points, step = two_heights.readings.points[rows[:20]], 0.002 * np.eye(3)
    known = [
        tile.variance(points + sign * each) - tile.unresolved(points + sign * each)
        for each in step
        for sign in (1, -1)
    ]
    slopes = [(up - down) / 0.004 for up, down in zip(known[::2], known[1::2], strict=True)]
    covariance = tile.gradient_beside_field(points)
    np.testing.assert_allclose(
        covariance, 0.5 * np.stack(slopes, axis=2), atol=1e-3 * np.abs(covariance).max()
    )


def test_exact_sensors_pull_as_is_expected_of_them(two_heights: HarmonicMap) -> None:
    """Fields and noise as the map believes them: 60 draws."""
    learnt, index = two_heights.learnt, fullest(two_heights)
    tile = two_heights.tiles[index]
    points, weight = learnt.readings.points, learnt.readings.weight
    suite = replace(heights_of(len(points)), sensor=(points[:, 2] > 0.5).astype(np.int64))
    F, rng = tile.basis.features(tile.within(points)), np.random.default_rng(2)
    pulls, chances = [], []
    for _ in range(60):
        field = F @ (tile.weights.prior_sigma * rng.standard_normal(len(tile.basis)))
        noise = rng.normal(0, 0.2, field.shape) / np.sqrt(weight)[:, None]
        drawn = replace(learnt, readings=replace(learnt.readings, field=field + noise))
        view = tile_view(drawn, Tiles(drawn), suite, index)
        pulls.append(view.system.pull[2::SIZE])
        chances.append(view.chance[2::SIZE])
    chance = chances[0]  # the same whatever is read
    np.testing.assert_allclose(chances, np.tile(chance, (60, 1)), rtol=1e-9)
    spread = np.std(pulls, axis=0) / np.sqrt(60)
    assert (np.abs(np.mean(pulls, axis=0) - chance) < 3.5 * spread).all()
    assert (np.abs(chance) > 10 * spread).any()


def test_what_is_expected_of_noise_is_no_weight() -> None:
    expected = np.array([60.0, -40.0])
    system = WeightSystem(100 * np.eye(2), expected)
    spectra = np.ones((1, 2))
    assert system.components_and_noise(spectra, 1e5).gain > 10
    assert system.components_and_noise(spectra, 1e5, expected).gain <= 0

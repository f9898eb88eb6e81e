"""Which waves a survey resolves, and tiles that share its places."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.modes import CEILING, FLOOR, modes_up_to
from l2m_gtsam.maps.harmonic.tiling import (
    WAVE_NUMBERS,
    Resolution,
    Tiling,
    TilingOptions,
    resolution_of,
    tiling_of,
)
from tests.reference.potentials import features
from tests.reference.tile_shares import tile_share
from tests.worlds.harmonic import GIVEN

POSITIVE = st.floats(0.05, 20.0)


@settings(max_examples=100)
@given(scale=POSITIVE, depth=st.floats(0.05, 5.0), density=st.floats(0.5, 1000), noise=POSITIVE)
def test_the_resolution_is_where_readings_tell_the_share(
    scale: float, depth: float, density: float, noise: float
) -> None:
    """Against the docstring's ratio on a fine grid of wave numbers."""
    h = GIVEN.model_copy(update={"floor_scale": scale, "floor_depth": depth, "noise": noise})
    share = 0.05
    found = resolution_of(h, density, share).floor
    low, high = WAVE_NUMBERS

    def ratio(k: float | FloatArray) -> FloatArray:
        spectrum = k * np.exp(-2 * k * depth) * (2 * depth) ** 3
        return np.asarray(4 * np.pi * scale**2 * spectrum * density / noise**2)

    beyond = np.linspace(found, high, 2000)[1:]
    assert low <= found <= high
    assert found == high or (ratio(beyond) < share).all()
    if low < found < high:
        assert ratio(found) == pytest.approx(share, rel=1e-6)


@settings(max_examples=50)
@given(scale=POSITIVE, depth=st.floats(0.05, 5.0), density=st.floats(0.5, 1000), noise=POSITIVE)
def test_better_surveys_never_resolve_less(
    scale: float, depth: float, density: float, noise: float
) -> None:
    h = GIVEN.model_copy(update={"floor_scale": scale, "floor_depth": depth, "noise": noise})
    once = resolution_of(h, density, 0.05).floor
    assert resolution_of(h, 2 * density, 0.05).floor >= once
    assert resolution_of(h, density, 0.02).floor >= once
    louder = h.model_copy(update={"noise": 2 * noise})
    assert resolution_of(louder, density, 0.05).floor <= once
    stronger = h.model_copy(update={"floor_scale": 2 * scale})
    assert resolution_of(stronger, density, 0.05).floor >= once


def test_readings_tell_of_a_mode_what_the_resolution_assumes() -> None:
    """4 pi s^2 (2h)^3 k exp(-2kh) density / sigma^2 against the normal matrix of readings."""
    edge, count = 6.0, 4000
    xy = np.random.default_rng(5).uniform(0, edge, (count, 2))
    modes = modes_up_to(FLOOR, np.full(2, edge), 0.0, 5.0)
    F = features(modes, np.column_stack([xy, np.zeros(count)]))
    information = np.einsum("nim,nim->m", F, F) / GIVEN.noise**2
    k, h = np.abs(modes.kz), GIVEN.floor_depth
    both = (modes.numbers > 0).all(axis=1)
    ratio = np.exp(modes.prior(GIVEN).log_variance) * information
    formula = 4 * np.pi * GIVEN.floor_scale**2 * (2 * h) ** 3 * k * np.exp(-2 * k * h)
    formula *= count / edge**2 / GIVEN.noise**2
    # Random places average a wave's square to 1 / sqrt(4000): 2 %, of 60 modes the worst 6 %.
    np.testing.assert_allclose(ratio[both], formula[both], rtol=0.1)


AREA = np.random.default_rng(6).uniform([-3, -2, 0.3], [9, 7, 0.9], (2000, 3))


@settings(max_examples=30)
@given(k=st.floats(2.0, 12.0), budget=st.integers(50, 2000))
def test_tiles_share_every_place_of_the_survey(k: float, budget: int) -> None:
    tiling = tiling_of(AREA, Resolution(k, 0.5 * k), TilingOptions(), budget, reach=0.5)
    total = sum(tile_share(tiling, AREA, tile) for tile in range(len(tiling)))
    # A polynomial and its mirror image sum to one to rounding.
    np.testing.assert_allclose(total, 1.0, rtol=0, atol=1e-12)
    assert all(len(rows) for rows in tiling.grid.members(AREA, tiling.overlap))


def test_tiles_are_as_large_as_their_budget() -> None:
    resolution, options = Resolution(6.0, 3.0), TilingOptions()
    tiling = tiling_of(AREA, resolution, options, 500, reach=0.5)
    assert resolution.modes(tiling.edge) <= 500
    counted = sum(
        len(modes_up_to(side, np.full(2, tiling.edge), 0.0, k))
        for side, k in ((FLOOR, 6.0), (CEILING, 3.0))
    )
    # A quarter of a disc of half waves; the modes along its straight sides come on top.
    assert counted == pytest.approx(resolution.modes(tiling.edge), rel=0.25)


def share_profile(tiling: Tiling, x: FloatArray) -> FloatArray:
    centre = tiling.grid.centres[0]
    points = np.column_stack([centre[0] + x, np.full(len(x), centre[1]), np.zeros(len(x))])
    return tile_share(tiling, points, 0)


def test_shares_fade_without_a_step_or_a_kink() -> None:
    tiling = tiling_of(AREA, Resolution(6.0, 3.0), TilingOptions(), 500, reach=0.5)
    x = np.linspace(0, tiling.grid.size, 4001)
    share = share_profile(tiling, x)
    edge, blend = 0.5 * tiling.grid.size, tiling.blend
    assert (share[x < edge - blend] == 1).all()
    assert (share[x > edge + blend] == 0).all()
    assert (np.diff(share) <= 0).all()
    step = x[1]
    # The smooth step of width w has slopes up to 1.9 / w, curvatures up to 5.8 / w^2, and third
    # derivatives up to 60 / w^3: nothing jumps by more than a step's worth of the next one.
    width = 2 * blend
    assert np.abs(np.diff(share)).max() < 2 * step / width
    assert np.abs(np.diff(share, 2)).max() < 6 * (step / width) ** 2
    assert np.abs(np.diff(share, 3)).max() < 61 * (step / width) ** 3

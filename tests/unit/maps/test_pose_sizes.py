"""Errors of a survey's poses count as found where more than one place shows them."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.pose_sizes import PARTS, PoseView, most_likely
from l2m_gtsam.solve.variance_components import WeightSystem

TILES, KNOTS, INFORMATION = 4, 12, 2e5  # of a height in 1/m^2: 2 mm by itself
NOISE = 0.2
HEIGHT = 5  # of the six errors of a pose


def views(heights: FloatArray, seed: int = 3) -> list[PoseView]:
    """Return what tiles say where heights at their knots have these deviations in metres, (T,)."""
    rng, found = np.random.default_rng(seed), []
    part = np.tile(PARTS, KNOTS)
    for deviation in heights:
        information = np.full(6 * KNOTS, INFORMATION)
        true = np.where(
            np.arange(6 * KNOTS) % 6 == HEIGHT, deviation * rng.standard_normal(6 * KNOTS), 0.0
        )
        pull = information * true + np.sqrt(information) * rng.standard_normal(6 * KNOTS)
        by_unit = np.full(4, 100.0)
        found.append(PoseView(WeightSystem(np.diag(information), pull), part, 1e6, by_unit))
    return found


def found_in(heights: FloatArray) -> FloatArray | None:
    def seen(unit: FloatArray, lasting_s: float) -> list[PoseView]:
        parts = np.unique(PARTS[unit > 0])
        return [each.among(parts) for each in views(heights)]

    found = most_likely(seen, NOISE, noise_known=True)
    return None if found is None else found.sizes


def test_what_all_places_show_is_found() -> None:
    """Of 48 heights a deviation is known to a tenth."""
    sizes = found_in(np.full(TILES, 0.01))
    assert sizes is not None
    assert sizes[HEIGHT] == pytest.approx(0.01, rel=0.4)


def test_what_one_place_shows_alone_is_no_error_of_poses() -> None:
    heights = np.zeros(TILES)
    heights[1] = 0.02
    assert found_in(heights) is None


def test_exact_poses_are_left_alone() -> None:
    assert found_in(np.zeros(TILES)) is None


def test_a_map_of_one_place_is_judged_by_that() -> None:
    assert found_in(np.array([0.01])) is not None

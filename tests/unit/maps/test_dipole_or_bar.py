"""Which shape a source has: decided by evidence, beside all others."""

import numpy as np
import pytest

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.sources.found_sources import refined
from l2m_gtsam.maps.sources.search import SourceSearchOptions, find_sources, reshaped
from l2m_gtsam.maps.sources.source import MOMENT, SourceShape
from tests.worlds.loop_rows import BAR, DIPOLE, loop_path, rows_with

OTHER = SourceShape.dipole(np.array([0.3, -1.5, 0.3]), np.array([-1.2, 0.8, 0.4]))
# Weak: what a wrong shape leaves is no source of its own.
WEAK = SourceShape.dipole(DIPOLE.position, 0.2 * DIPOLE.moment)
AXES = [np.zeros(3), BAR.half_axis, np.array([0.3, 0.1, 0.0])]


def field_of(*shapes: SourceShape) -> FloatArray:
    return sum((each.field_and_gradient(loop_path())[0] for each in shapes), np.zeros((240, 3)))


@pytest.mark.parametrize("of_now", AXES)
@pytest.mark.parametrize("true", AXES[:2])
def test_a_wrong_shape_is_put_right(true: FloatArray, of_now: FloatArray) -> None:
    rows = rows_with(field_of(OTHER, WEAK.with_half_axis(true)), 3)
    found = reshaped(rows, refined(rows, (OTHER, WEAK.with_half_axis(of_now))))
    assert not found.shapes[0].is_bar
    assert found.shapes[1].is_bar == true.any()
    assert not found.shapes[1].half_axis[:2].any()


def test_two_dipoles_are_one_bar() -> None:
    """Found one after the other they explain a bar: the search ends with the bar alone."""
    rows = rows_with(field_of(BAR), 4)
    two = refined(
        rows,
        tuple(
            SourceShape.dipole(BAR.position + end * BAR.half_axis, BAR.moment / 2)
            for end in (-0.5, 0.5)
        ),
    )
    found = find_sources(rows, rows.points, SourceSearchOptions(), two)
    assert [each.is_bar for each in found.shapes] == [True]


@pytest.mark.parametrize("seeds", [8, pytest.param(30, marks=pytest.mark.study)])
def test_moments_are_as_sure_as_they_say(seeds: int) -> None:
    """Bars of which readings leave the length half open: a moment errs by its sigmas.

    Not quite: one whose length is left open is a bar or none, and no mixture of both.
    """
    squared, beside = [], SourceShape.dipole(np.array([1.0, 2.0, 0.5]), DIPOLE.moment)
    for seed in range(seeds):
        half = abs(np.random.default_rng(seed).normal(0, 0.5))
        true = beside.with_half_axis(np.array([0.0, 0.0, half]))
        rows = rows_with(field_of(true), 100 + seed)
        found = find_sources(rows, rows.points, SourceSearchOptions(), None)
        assert len(found) == 1
        error = found.shapes[0].moment - true.moment
        squared.append(error @ np.linalg.solve(found.covariance[MOMENT, MOMENT], error))
    # Chi-squares of three degrees: 5.0 here, and 15 where shapes are not decided again.
    assert np.mean(squared) < 7

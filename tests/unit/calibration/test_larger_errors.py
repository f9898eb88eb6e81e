"""Maps that err more than they state, where places are judged that changed."""

from typing import Any

import numpy as np
import pytest

from l2m_gtsam.calibration.changed_places import is_place_of
from l2m_gtsam.calibration.coverage import Coverage, errors_over_stated


class Erring:
    """A map of which held-out readings are known."""

    def __init__(self, times: float) -> None:
        self.errors_over_stated = times


def test_coverage_with_larger_errors_has_less_information() -> None:
    lower = np.linalg.cholesky(np.array([[4.0, 1.0], [1.0, 2.0]]))
    stated = Coverage((), np.ones((3, 3)), {0: 2}, lower, None, np.zeros(3))
    larger = stated.with_larger_errors(2.0)
    np.testing.assert_allclose(larger.rest, 4.0)
    np.testing.assert_allclose(larger.tile_information, stated.tile_information / 4)


@pytest.mark.parametrize(("times", "searched"), [(1.0, True), (2.2, True), (3.5, False)])
def test_steel_is_looked_for_where_a_map_is_of_the_place(times: float, searched: bool) -> None:
    field_map: Any = Erring(times)
    assert errors_over_stated(field_map) == times
    assert is_place_of(field_map) is searched


def test_a_map_that_does_not_know_its_errors_is_taken_at_its_word() -> None:
    assert errors_over_stated(object()) == 1.0

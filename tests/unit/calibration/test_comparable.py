"""Sensors that do not say what the field is: no change is looked for by their readings."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from l2m_gtsam.calibration.changed_places import ChangesOptions, search
from l2m_gtsam.calibration.jumping_solve import shown_jumps
from l2m_gtsam.calibration.one_key import OneKeySolution
from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.calibration.stretch_causes import with_causes
from l2m_gtsam.data import Readings
from tests.drives.uncertain import surveyed


def solution(*, stayed: frozenset[int] = frozenset()) -> OneKeySolution:
    """Return a solve of two sensors without readings, the second with a dead axis."""
    none = np.zeros(0, dtype=np.int64)
    readings = Readings(
        ("a", "b"), none, none, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3))
    )
    C = np.stack([np.eye(3), np.diag([1.0, 1.0, 1e-9])])
    estimate: Any = SimpleNamespace(C=lambda: C)
    solved: Any = (SimpleNamespace(sensor=0), SimpleNamespace(sensor=1))
    inside = np.zeros(0, dtype=np.bool_)
    return OneKeySolution(
        readings, estimate, solved, inside, inside, 1, Ending.TOLERANCE, frozenset(), stayed=stayed
    )


def test_a_dead_axis_and_a_sensor_that_left_are_not_comparable() -> None:
    assert solution().comparable == (0,)
    assert solution(stayed=frozenset({0})).comparable == ()


def test_without_comparable_sensors_nothing_is_looked_for() -> None:
    nothing, field_map, options = solution(stayed=frozenset({0})), surveyed(1), ChangesOptions()
    stretches: Any = (SimpleNamespace(),)
    assert search(nothing, field_map, options, None) is None
    assert shown_jumps(nothing, field_map, options) == ()
    assert with_causes(stretches, nothing, field_map, options) is stretches

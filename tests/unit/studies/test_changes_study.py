"""What changes in the halls of the study of places that change, and what counts as found."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.simulate.hall_drives import CLEARANCE_M
from l2m_gtsam.simulate.steel_hall import HALF_AREA, steel_hall
from l2m_gtsam.studies.changes.cells import (
    ChangesCell,
    SensorErrors,
    TrueChange,
    false_alarms,
    found_changes,
)
from l2m_gtsam.studies.changes.loads import (
    ChangesStudyOptions,
    Loads,
    five_changes,
    joined,
    outside,
)
from l2m_gtsam.studies.changes.study import CHANGES

OPTIONS = ChangesStudyOptions()
RNG = np.random.default_rng(0)
LOADS = Loads(RNG.uniform(0, 2, (5, 3)), RNG.normal(0, 5, (5, 3)))


def test_five_sources_change() -> None:
    """One comes, one goes, one is moved, which is two, and one comes outside of the area."""
    changes = five_changes(OPTIONS, LOADS, 0, 1, 2, np.random.default_rng(1))
    np.testing.assert_array_equal(changes.positions[:3], LOADS.positions[:3])
    np.testing.assert_array_equal(changes.moments[0], LOADS.moments[0])
    np.testing.assert_array_equal(changes.moments[1:3], -LOADS.moments[1:3])
    np.testing.assert_array_equal(changes.moments[3], LOADS.moments[2])
    low, high = OPTIONS.moment
    assert low <= np.linalg.norm(changes.moments[4]) <= high
    beyond = np.abs(changes.positions[3:, :2]) - HALF_AREA
    assert (beyond.max(axis=1) >= OPTIONS.beyond[0]).all()


@pytest.mark.parametrize("seed", range(5))
def test_outside_is_within_what_is_asked_for(seed: int) -> None:
    place = outside(OPTIONS, np.random.default_rng(seed))
    over = (np.abs(place[:2]) - HALF_AREA).max()
    assert OPTIONS.beyond[0] <= over <= OPTIONS.beyond[1]
    low, high = OPTIONS.heights_of_steel
    assert low <= place[2] <= high


def test_a_world_with_loads_has_the_field_of_both() -> None:
    hall = steel_hall(3)
    points = np.random.default_rng(2).uniform(-2, 2, (50, 3)) + np.array([0, 0, 3])
    points = points[hall.free(points, CLEARANCE_M)]
    both = joined(hall.world, LOADS.steel(OPTIONS)).field(points)
    apart = hall.world.field(points) + LOADS.steel(OPTIONS).field(points)
    np.testing.assert_allclose(both, apart, atol=1e-9)


def test_found_is_what_is_near_with_its_moment() -> None:
    def source(position: Any, moment: Any) -> Any:
        return SimpleNamespace(position=np.array(position), moment=np.array(moment))

    changes = Loads(np.array([[0, 0, 1.0], [5, 0, 1]]), np.array([[0, 0, 10.0], [0, 4, 0]]))
    sources = (source([0.1, 0, 1], [0, 0, 9.0]), source([9, 0, 1], [1, 0, 0.0]))
    points = np.array([[0, 0, 2.0], [5, 2, 1]])
    near, far = found_changes(changes, sources, points, OPTIONS)
    assert near.away_m == pytest.approx(0.1)
    assert near.moment_ratio == pytest.approx(0.9)
    assert (near.nearest_m, far.nearest_m) == (1.0, 2.0)
    # On the axis of a dipole 0.2 m / r^3, of a cube to the fourth power of its size.
    assert near.strongest_ut == pytest.approx(0.2 * 10, rel=0.01)
    assert (far.away_m, far.moment_ratio) == (None, None)
    assert false_alarms(sources, changes.positions) == 1


def test_drives_without_changes_are_cells_of_their_own() -> None:
    keys = CHANGES.keys(ChangesStudyOptions(halls=2, paths=1, unchanged=2))
    assert keys == tuple(
        f"hall-{hall:03d}-{kind}"
        for hall in range(2)
        for kind in ("path-0", "unchanged-1", "unchanged-2")
    )


def test_the_page_counts_what_is_found() -> None:
    found, missed = (
        TrueChange(5, True, 0.9, 1.5, 0.1, 0.9),
        TrueChange(2, False, 1.8, 0.15, None, None),
    )
    cell = ChangesCell(
        1, (found, missed), 1, 0, 0.5, 0.5, (SensorErrors(0.003, 0.004, True, False),) * 2, 0.1
    )
    unchanged = ChangesCell(1, (), 0, 1, 0.0, 2.0, (), 0.0)
    options = ChangesStudyOptions(halls=1, paths=2)
    summary = CHANGES.summarise(options, {"a": cell, "b": cell, "c": unchanged})
    page = CHANGES.page(summary)
    assert "| 3 to 10 |  | 2 of 2 |  |  |" in page
    assert "| 1 to 2 | 2 of 2 | 0.10 | 10 % |" in page
    assert "| 0.1 to 0.2 | 0 of 2 | | |" in page
    assert "2 of 2; 0 of 2" in page  # what came, what went
    assert "| false alarms without changes | 1 in 3.0 hours |" in page
    assert "| 2 in 1.0 hours |" in page
    assert "| 3.0 mm; 4.0 mm |" in page
    assert set(CHANGES.figures(summary)) == {"changes"}


def test_without_a_result_no_error_is_stated() -> None:
    none = SensorErrors(0.003, None, True, False)
    cell = ChangesCell(1, (), 0, 0, 0.5, 0.5, (none,), 0.0)
    summary = CHANGES.summarise(ChangesStudyOptions(), {"a": cell})
    assert summary.clean_m == pytest.approx(0.003)
    assert summary.changed_m is None
    assert "| 3.0 mm; none |" in CHANGES.page(summary)

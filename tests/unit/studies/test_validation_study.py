"""What counts as right in the validation study, and what its summary counts."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.data import Trajectory
from l2m_gtsam.qa.verdict.sensor import WRONG_MAP
from l2m_gtsam.records.validation import CalibrationPart, Displaced
from l2m_gtsam.records.verdict import Level, Reason, Verdict
from l2m_gtsam.simulate.hall_drives import calibration_drive
from l2m_gtsam.simulate.steel_hall import steel_hall
from l2m_gtsam.studies.validation.drives import (
    TrueCause,
    ValidationStudyOptions,
    altered,
    driven_at,
)
from l2m_gtsam.studies.validation.study import VALIDATION, ValidationCell, change_of, is_right

OPTIONS = ValidationStudyOptions()
STEEL = np.array([1.0, 2.0, 0.5])
TURN, MOVE, IRON = CalibrationPart.ROTATION, CalibrationPart.PLACE, CalibrationPart.OFFSET


def said(
    *parts: set[CalibrationPart],
    sources: tuple[float, ...] = (),
    displaced: tuple[Displaced, ...] = (),
    jumps: int = 0,
    drifts: int = 0,
) -> Any:
    """What a validation found: parts of each sensor, and sources so far from the steel.

    And what all sensors share.
    """
    return SimpleNamespace(
        displacement=SimpleNamespace(of=displaced) if displaced else None,
        jumps=(None,) * jumps,
        drifts=(None,) * drifts,
        sensors=[
            SimpleNamespace(changes=[SimpleNamespace(part=p) for p in each]) for each in parts
        ],
        sources=[SimpleNamespace(position=STEEL + np.array([off, 0, 0])) for off in sources],
    )


NONE: tuple[set[CalibrationPart], ...] = (set(), set())


@pytest.mark.parametrize(
    ("change", "found", "right"),
    [
        (TrueCause.NOTHING, said(*NONE), True),
        (TrueCause.NOTHING, said(*NONE, sources=(0.1,)), False),
        (TrueCause.NOTHING, said({IRON}, set()), False),
        (TrueCause.PLACE, said(*NONE, sources=(0.9, 0.1)), True),
        (TrueCause.PLACE, said(*NONE, sources=(0.9,)), False),
        (TrueCause.PLACE, said(*NONE), False),
        (TrueCause.PLACE, said({IRON}, set(), sources=(0.1,)), False),
        (TrueCause.TURNED, said({TURN}, {TURN, MOVE}), True),
        (TrueCause.TURNED, said({TURN}, set()), False),
        (TrueCause.TURNED, said(*NONE, displaced=(Displaced.LIDAR,)), True),
        (TrueCause.TURNED, said(*NONE, displaced=(Displaced.LIDAR, Displaced.FRAME)), True),
        (TrueCause.TURNED, said(*NONE, displaced=(Displaced.FRAME,)), False),
        (TrueCause.TURNED, said({TURN}, set(), displaced=(Displaced.LIDAR,)), False),
        (TrueCause.NOTHING, said(*NONE, displaced=(Displaced.LIDAR,)), False),
        (TrueCause.NOTHING, said(*NONE, jumps=1), False),
        (TrueCause.NOTHING, said(*NONE, drifts=1), False),
        (TrueCause.TURNED, said({TURN, IRON}, {TURN}), False),
        (TrueCause.IRON, said({IRON}, {IRON}), True),
        (TrueCause.IRON, said({IRON}, {IRON, MOVE}), False),
        (TrueCause.BOTH, said({IRON}, {IRON}, sources=(0.1,)), True),
        (TrueCause.BOTH, said({IRON}, {IRON}), False),
        (TrueCause.SENSOR, said(set(), {TURN}), True),
        (TrueCause.SENSOR, said({TURN}, {TURN}), False),
        (TrueCause.ELSEWHERE, said(*NONE), False),
    ],
)
def test_right_is_what_changed_and_nothing_else(change: TrueCause, found: Any, right: bool) -> None:
    brought = change in (TrueCause.PLACE, TrueCause.BOTH)
    drive: Any = SimpleNamespace(steel=STEEL if brought else None)
    assert is_right(change, drive, found, Verdict.of([], [])) is right


@pytest.mark.parametrize(
    ("text", "sources", "right"),
    [
        (f"{WRONG_MAP} The calibration was not tested.", (), True),
        (f"{WRONG_MAP} The calibration was not tested.", (0.1,), False),
        ("The place changed, not the vehicle", (), False),
    ],
)
def test_of_another_place_it_is_said_that_the_map_does_not_fit(
    text: str, sources: tuple[float, ...], right: bool
) -> None:
    verdict = Verdict.of([Reason(Level.FAIL, text)], [])
    found = said(*NONE, sources=sources)
    drive: Any = SimpleNamespace(steel=None)
    assert is_right(TrueCause.ELSEWHERE, drive, found, verdict) is right


def test_a_vehicle_changes_as_it_is_told() -> None:
    sensors = calibration_drive(steel_hall(1), 1, (0.4, 1.0), 0.2, 3, 30).sensors
    rng = np.random.default_rng(0)
    assert altered(OPTIONS, sensors, TrueCause.NOTHING, rng) == sensors
    turned = altered(OPTIONS, sensors, TrueCause.TURNED, rng)
    apart = [
        [np.linalg.norm(a.t_lidar_mag - b.t_lidar_mag) for a in each for b in each]
        for each in (sensors, turned)
    ]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-12)  # a rigid mount
    for old, new in zip(sensors, turned, strict=True):
        R = np.linalg.solve(old.distortion.C, new.distortion.C)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        angle = np.rad2deg(np.arccos((np.trace(R) - 1) / 2))
        assert OPTIONS.turn_deg[0] <= angle <= OPTIONS.turn_deg[1]
    single = altered(OPTIONS, sensors, TrueCause.SENSOR, rng)
    assert single[:-1] == sensors[:-1]
    np.testing.assert_array_equal(single[-1].t_lidar_mag, sensors[-1].t_lidar_mag)
    for old, new in zip(sensors, altered(OPTIONS, sensors, TrueCause.IRON, rng), strict=True):
        size = np.linalg.norm(new.distortion.H - old.distortion.H)
        assert OPTIONS.iron_ut[0] <= size <= OPTIONS.iron_ut[1]
        np.testing.assert_array_equal(new.distortion.C, old.distortion.C)


def test_all_changes_take_turns() -> None:
    keys = VALIDATION.keys(OPTIONS)
    cases = [change_of(OPTIONS, key) for key in keys if "case" in key]
    assert len(cases) == 40
    assert {cases.count(each) for each in TrueCause} == {5, 6}
    rest = [change_of(OPTIONS, key) for key in keys if "unchanged" in key]
    assert rest == [TrueCause.NOTHING] * 60


def test_the_page_counts_what_is_right_and_tells_what_is_not() -> None:
    options = ValidationStudyOptions(halls=1, cases=2, unchanged=1)
    good = ValidationCell(TrueCause.NOTHING, 900, "pass", True, False, ((), ()), None, 0, "")
    bad = replace(
        good, change=TrueCause.PLACE, right=False, tied=True, level="warn", away_m=0.4, sources=1,
        words="It cannot be told",
    )  # fmt: skip
    cells = dict(zip(VALIDATION.keys(options), (good, bad, good), strict=True))
    summary = VALIDATION.summarise(options, cells)
    assert (summary.right, summary.drives, summary.unchanged.right) == (1, 2, 1)
    assert summary.wrong == (bad,)
    page = VALIDATION.page(summary)
    assert "| place | 1 | 0 | 1 | 0 | 0.40 |" in page
    assert "| 900 | place | It cannot be told Parts: -; - | warn |" in page
    assert set(VALIDATION.figures(summary)) == {"validation"}


def test_a_path_around_structures_is_no_faster_than_a_vehicle() -> None:
    """Steps that are short keep their time; one of 2 m takes two seconds."""
    p = np.array([[0.0, 0, 0], [0.01, 0, 0], [2.01, 0, 0], [2.02, 0, 0]])
    stamps = 10**9 + 50_000_000 * np.arange(4)
    poses = Trajectory(stamps, np.tile(np.eye(3), (4, 1, 1)), p, "map", "lidar")
    found = driven_at(poses, 1.0)
    np.testing.assert_allclose(np.diff(found.stamp_ns), [50_000_000, 2_000_000_000, 50_000_000])
    assert found.stamp_ns[0] == stamps[0]
    np.testing.assert_array_equal(found.p, p)

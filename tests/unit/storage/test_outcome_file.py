"""``outcome.json``: read back as it was, and not believed when it was damaged or edited."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.qa.fleet import DIGITS
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.fleet import VERDICTS, Computation, DriveOutcome, RowKey
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.record_files import read_outcome, write_outcome
from tests.drives.fleet_rows import sensor_row

KEY = RowKey("0" * 64, "1" * 64, "2" * 64, "1.0")
MADE = Computation("2026-05-01T09:00:00Z", 3.0)
CALIBRATED = DriveOutcome(KEY, "2026-05-01T08:00:00Z", 60.0, (sensor_row(),), "", True, MADE)
NO_ROTATION = (math.nan,) * 4
FAILED = DriveOutcome(KEY, "", 0.0, (), "b.bag: truncated", True, MADE)


def test_verdicts_are_those_of_the_report() -> None:
    assert tuple(level.value for level in Level) == VERDICTS


@given(st.integers(0, 10_000), st.sampled_from(VERDICTS))
def test_an_outcome_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, seed: int, verdict: str
) -> None:
    """With any rotation, as rounded as it is written."""
    turned = row(np.asarray(Rotation.random(random_state=seed).as_quat(canonical=True)), DIGITS)
    sensor = sensor_row(quaternion_xyzw=turned, verdict=verdict, t_sigma=(math.inf,) * 3)
    outcome = DriveOutcome(KEY, CALIBRATED.start, 60.0, (sensor,), "", True, MADE)
    path = tmp_path_factory.getbasetemp() / "outcome.json"
    write_outcome(path, outcome)
    assert read_outcome(path) == outcome


def test_a_drive_or_a_sensor_without_results_is_read_back(tmp_path: Path) -> None:
    write_outcome(tmp_path / "failed.json", FAILED)
    assert read_outcome(tmp_path / "failed.json") == FAILED
    unsolved = sensor_row(quaternion_xyzw=NO_ROTATION, verdict="fail")
    outcome = DriveOutcome(KEY, CALIBRATED.start, 60.0, (unsolved,), "", True, MADE)
    write_outcome(tmp_path / "unsolved.json", outcome)
    found = read_outcome(tmp_path / "unsolved.json")
    assert found is not None
    assert np.isnan(found.sensors[0].quaternion_xyzw).all()


Edit = Callable[[dict[str, Any]], None]


def of_sensor(name: str, value: Any) -> Edit:
    def edit(outcome: dict[str, Any]) -> None:
        assert name in outcome["sensors"][0]
        outcome["sensors"][0][name] = value

    return edit


def of_drive(name: str, value: Any) -> Edit:
    def edit(outcome: dict[str, Any]) -> None:
        assert name in outcome
        outcome[name] = value

    return edit


def without_version(outcome: dict[str, Any]) -> None:
    del outcome["key"]["program"]


@pytest.mark.parametrize(
    "edit",
    [
        of_sensor("verdict", "splendid"),
        of_sensor("verdict", "error"),
        of_sensor("t", [0.1, 0.2]),
        of_sensor("t_sigma", [0.1] * 4),
        of_sensor("rotation_sigma", []),
        of_sensor("scale", [1.0]),
        of_sensor("H", [1.0] * 4),
        of_sensor("H_sigma", [1.0] * 2),
        of_sensor("H", ["a", "b", "c"]),
        of_sensor("quaternion_xyzw", [0.0, 0.0, 1.0]),
        of_sensor("quaternion_xyzw", [0.0] * 4),
        of_sensor("quaternion_xyzw", [0.0, 0.0, 0.0, 1.001]),
        of_sensor("quaternion_xyzw", ["NaN", 0.0, 0.0, 1.0]),
        of_sensor("quaternion_xyzw", ["Infinity", 0.0, 0.0, 1.0]),
        of_drive("start", "yesterday"),
        of_drive("start", "2026-02-30T08:00:00Z"),
        of_drive("start", "2026-05-01"),
        of_drive("duration", -1.0),
        of_drive("duration", "NaN"),
        of_drive("sensors", []),
        of_drive("error", "calibrated, and not"),
        without_version,
    ],
)
def test_what_cannot_have_been_written_is_no_outcome(tmp_path: Path, edit: Edit) -> None:
    path = tmp_path / "outcome.json"
    write_outcome(path, CALIBRATED)
    assert read_outcome(path) == CALIBRATED
    content = json.loads(path.read_text())
    edit(content["outcome"])
    path.write_text(json.dumps(content))
    assert read_outcome(path) is None

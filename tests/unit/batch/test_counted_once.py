"""A recording under two names is one drive of a fleet."""

from dataclasses import replace

from l2m_gtsam.batch.fleet import counted_once
from l2m_gtsam.records.fleet import Computation, DriveOutcome, RowKey
from tests.drives.fleet_rows import sensor_row

MADE = Computation("2026-05-01T09:00:00Z", 3.0)


def outcome(bag: str, field_map: str = "m", error: str = "") -> DriveOutcome:
    key = RowKey(bag, field_map, "c", "0.1.0")
    return DriveOutcome(key, "", 60.0, () if error else (sensor_row(),), error, True, MADE)


def test_the_first_name_counts_and_the_other_is_told() -> None:
    found = counted_once({"a/one": outcome("x"), "b/copy": outcome("x"), "b/two": outcome("y")})
    assert found["a/one"] == outcome("x")
    assert found["b/two"] == outcome("y")
    assert found["b/copy"].sensors == ()
    assert "the same recording as a/one" in found["b/copy"].error


def test_other_maps_and_options_make_other_rows() -> None:
    changed = replace(outcome("x"), key=replace(outcome("x").key, config="other"))
    given = {"a": outcome("x"), "b": outcome("x", "another map"), "c": changed}
    assert counted_once(given) == given


def test_what_failed_keeps_its_own_reason() -> None:
    """Unread bags have no digest."""
    given = {"a": outcome("", error="truncated"), "b": outcome("", error="no poses")}
    assert counted_once(given) == given
    assert counted_once({"a": outcome("x", error="no poses"), "b": outcome("x")})["b"].sensors

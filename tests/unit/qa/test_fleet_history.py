"""Verdicts of a vehicle stand in order of time, whatever the order of the rows."""

from dataclasses import replace
from typing import Any

from l2m_gtsam.qa.fleet import verdict_histories
from l2m_gtsam.qa.options import FleetOptions
from l2m_gtsam.qa.report.fleet_page import fleet_page
from tests.drives.fleet_rows import row, sensor_row


def test_verdicts_are_in_order_of_time() -> None:
    one = row()
    assert one.sensor is not None
    days = [("b", "2024-01-02T00:00:00Z", "fail"), ("c", "2024-01-03T00:00:00Z", "warn")]
    days.insert(0, ("a", "2024-01-04T00:00:00Z", "pass"))
    rows = [
        replace(one, bag=bag, folder=bag, date=date, sensor=replace(one.sensor, verdict=level))
        for bag, date, level in days
    ]
    lost = row(bag="d", folder="d", date="2024-01-01T00:00:00Z", error="no poses")
    lost = replace(lost, sensor=None)
    alone = replace(one, vehicle="other")
    (found,) = verdict_histories([*rows, lost, alone])
    assert found.vehicle == one.vehicle
    assert [bag for bag, _ in found.drives] == ["d", "b", "c", "a"]
    assert found.sensors == ((one.sensor.sensor, (None, "fail", "warn", "pass")),)
    assert "Verdicts over time" in fleet_page([*rows, alone], FleetOptions())
    assert "Verdicts over time" not in fleet_page([alone], FleetOptions())


def test_drives_of_one_name_and_date_are_several() -> None:
    """Clocks that were never set all begin at the same time."""
    same: dict[str, Any] = {"bag": "drive.mcap", "date": "1970-01-01T00:00:05Z"}
    good = row(folder="truck/day1", **same)
    bad = row(folder="truck/day2", sensor=sensor_row(verdict="fail"), **same)
    (found,) = verdict_histories([good, bad])
    assert found.drives == (("drive.mcap", "1970-01-01T00:00:05Z"),) * 2
    assert found.sensors == (("mag", ("pass", "fail")),)

"""Rows of a fleet made up for tests of what is done with them."""

from datetime import UTC, datetime, timedelta
from typing import Any

from l2m_gtsam.records.fleet import FleetRow, SensorRow

FIRST = datetime(2026, 5, 1, 8, tzinfo=UTC)


def sensor_row(name: str = "mag", **changes: Any) -> SensorRow:
    """Return a sensor that was calibrated well."""
    facts: dict[str, Any] = {
        "sensor": name,
        "verdict": "pass",
        "reason": "",
        "t": (0.31, -0.12, 0.05),
        "t_sigma": (0.002, 0.002, 0.003),
        "quaternion_xyzw": (0.0, 0.0, 0.0, 1.0),
        "rotation_sigma": (0.05, 0.05, 0.02),
        "scale": (1.01, 0.98, 1.02),
        "H": (3.0, -2.0, 6.0),
        "H_sigma": (0.1, 0.1, 0.1),
        "hard_iron": 7.0,
        "hard_iron_sigma": 0.1,
        "residual_rms": 0.2,
        "chi2": 1.02,
        "rejected": 0.01,
    }
    return SensorRow(**{**facts, **changes})


def row(day: int = 0, sensor: SensorRow | None = None, **changes: Any) -> FleetRow:
    """Return a drive on a day."""
    date = (FIRST + timedelta(days=day)).strftime("%Y-%m-%dT%H:%M:%SZ")
    facts: dict[str, Any] = {
        "vehicle": "truck",
        "bag": f"day_{day}.bag",
        "folder": f"truck/day_{day}",
        "date": date,
        "duration": 60.0,
        "sensor": sensor or sensor_row(),
        "error": "",
    }
    return FleetRow(**{**facts, **changes})

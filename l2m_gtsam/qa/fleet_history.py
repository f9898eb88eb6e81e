"""The verdicts of each vehicle of a fleet, drive by drive."""

from collections.abc import Sequence
from dataclasses import dataclass

from l2m_gtsam.records.fleet import FleetRow


@dataclass(frozen=True)
class VerdictHistory:
    """The verdicts on the sensors of a vehicle, in order of time.

    Attributes
    ----------
    vehicle
        Its name.
    drives
        Names of bags with their dates, the oldest first.
    sensors
        Names, and a verdict for each drive; none where the drive was not calibrated, or has no such
        sensor.
    """

    vehicle: str
    drives: tuple[tuple[str, str], ...]
    sensors: tuple[tuple[str, tuple[str | None, ...]], ...]


def verdict_histories(rows: Sequence[FleetRow]) -> tuple[VerdictHistory, ...]:
    """Return the histories of all vehicles that have several drives, in the order of the rows."""
    found = [_history(name, rows) for name in dict.fromkeys(row.vehicle for row in rows)]
    return tuple(each for each in found if len(each.drives) > 1)


def _history(vehicle: str, rows: Sequence[FleetRow]) -> VerdictHistory:
    own = [row for row in rows if row.vehicle == vehicle]
    drives = sorted({(row.date, row.bag) for row in own})
    levels = {
        (row.sensor.sensor, row.date, row.bag): row.verdict for row in own if row.sensor is not None
    }
    names = sorted({name for name, _, _ in levels})
    sensors = tuple((name, tuple(levels.get((name, *drive)) for drive in drives)) for name in names)
    return VerdictHistory(vehicle, tuple((bag, date) for date, bag in drives), sensors)

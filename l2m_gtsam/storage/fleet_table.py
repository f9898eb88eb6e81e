"""``fleet.csv`` and ``fleet.parquet``: every row of a fleet with all its numbers."""

import csv
import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from l2m_gtsam.records.fleet import DATE, FleetRow, SensorRow
from l2m_gtsam.records.record import Row
from l2m_gtsam.storage.files import atomic_path

MISSING = "fleet.parquet needs pyarrow, fleet.csv has the same: pip install 'l2m-gtsam[fleet]'"
TEXTS = ("vehicle", "bag", "sensor", "verdict", "sensor_verdict", "reason", "outliers", "folder")
# What spreadsheets take for a formula at the beginning of a cell.
FORMULA = ("=", "+", "-", "@", "\t", "\r")

Cell = str | float


def flat(row: FleetRow) -> dict[str, Cell]:
    """Return a row as columns: units at the end of their names, NaN where there is no number."""
    sensor = row.sensor
    return {
        "vehicle": row.vehicle,
        "bag": row.bag,
        "date": row.date,
        "sensor": "" if sensor is None else sensor.sensor,
        "verdict": row.verdict,
        "sensor_verdict": "" if sensor is None else sensor.own_verdict,
        "reason": row.reason,
        "outliers": "; ".join(map(str, row.outliers)),
        **_numbers(sensor),
        "drive_s": row.duration if sensor is not None else math.nan,
        "folder": row.folder,
    }


def write_csv(path: Path, rows: Sequence[FleetRow]) -> None:
    """Write the table as CSV (RFC 4180, UTF-8); empty cells for numbers that do not exist.

    Text that a spreadsheet would take for a formula gets an apostrophe in front.
    """
    columns = list(flat(_EMPTY))
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="replace", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(columns)
        for row in rows:
            writer.writerow([_cell(value) for value in flat(row).values()])


def write_parquet(path: Path, rows: Sequence[FleetRow]) -> tuple[str, ...]:
    """Write the table as Parquet, dates as stamps in UTC; say so where that needs more software.

    A table of an earlier run is removed then: it is not this one.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        path.unlink(missing_ok=True)
        return (MISSING,)
    columns = {name: [flat(row)[name] for row in rows] for name in flat(_EMPTY)}
    types = {name: pa.string() if name in TEXTS else pa.float64() for name in columns}
    types["date"] = pa.timestamp("ms", tz="UTC")
    values: dict[str, list[Any]] = {**columns, "date": [_stamp(row.date) for row in rows]}
    readable = {name: [_readable(value) for value in values[name]] for name in columns}
    table = pa.Table.from_pydict(readable, schema=pa.schema(types.items()))
    with atomic_path(path) as temporary:
        pq.write_table(table, temporary, version="2.6")
    return ()


_EMPTY = FleetRow("", "", "", "", math.nan, None, "")
_NO_ROW: Row = (math.nan,) * 4


def _numbers(sensor: SensorRow | None) -> dict[str, Cell]:
    parts = (
        ("t_{}_m", "xyz", "t"),
        ("t_{}_sigma_m", "xyz", "t_sigma"),
        ("R_lidar_mag_q{}", "xyzw", "quaternion_xyzw"),
        ("rotation_{}_sigma_deg", "xyz", "rotation_sigma"),
        ("scale_{}", "xyz", "scale"),
        ("H_{}_uT", "xyz", "H"),
        ("H_{}_sigma_uT", "xyz", "H_sigma"),
    )
    singles = {
        "H_uT": "hard_iron",
        "H_sigma_uT": "hard_iron_sigma",
        "residual_rms_uT": "residual_rms",
        "chi2_per_dof": "chi2",
        "rejected_share": "rejected",
    }
    cells: dict[str, Cell] = {}
    for name, axes, field in parts:
        values: Row = _NO_ROW if sensor is None else getattr(sensor, field)
        cells |= {name.format(axis): value for axis, value in zip(axes, values, strict=False)}
    for name, field in singles.items():
        cells[name] = math.nan if sensor is None else getattr(sensor, field)
    return cells


def _cell(value: Cell) -> str:
    """Return a cell as CSV has it."""
    if isinstance(value, str):
        return f"'{value}" if value.startswith(FORMULA) else value
    return "" if math.isnan(value) else repr(float(value))


def _readable(value: Any) -> Any:
    """Return a value that is UTF-8 if it is text, and null if it is no number."""
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode("utf-8")
    return None if isinstance(value, float) and math.isnan(value) else value


def _stamp(date: str) -> datetime | None:
    return datetime.strptime(date, DATE).replace(tzinfo=UTC) if date else None

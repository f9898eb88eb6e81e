"""``fleet.csv`` and ``fleet.parquet`` read back, whatever the names are."""

import csv
import math
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from l2m_gtsam.records.fleet import FleetRow, Outlier
from l2m_gtsam.storage.fleet_table import FORMULA, flat, write_csv, write_parquet
from tests.drives.fleet_rows import row, sensor_row

TEXT = st.text(max_size=20)
NUMBER = st.floats(allow_nan=True, allow_infinity=True)
THREE = st.tuples(NUMBER, NUMBER, NUMBER)


@st.composite
def fleet_rows(draw: st.DrawFn) -> FleetRow:
    """Rows with any text and any numbers, infinite ones too; some drives failed."""
    sensor = sensor_row(draw(TEXT), reason=draw(TEXT), t=draw(THREE), H_sigma=draw(THREE))
    made = row(draw(st.integers(0, 999)), sensor)
    made = replace(made, vehicle=draw(TEXT), bag=draw(TEXT), folder=draw(TEXT))
    failed = replace(made, date="", sensor=None, error=draw(TEXT))
    return failed if draw(st.booleans()) else made


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as path:
        yield Path(path)


@settings(max_examples=30)
@given(st.lists(fleet_rows(), max_size=5))
def test_a_csv_has_every_number_to_the_last_digit(rows: list[FleetRow]) -> None:
    with folder() as out:
        write_csv(out / "fleet.csv", rows)
        with (out / "fleet.csv").open(encoding="utf-8", newline="") as file:
            found = list(csv.DictReader(file))
    assert len(found) == len(rows)
    for cells, each in zip(found, rows, strict=True):
        for name, value in flat(each).items():
            if isinstance(value, str):
                plain = value.encode("utf-8", "replace").decode()
                assert cells[name] in (plain, f"'{plain}")
                assert not cells[name].startswith(FORMULA)
            elif math.isnan(value):
                assert cells[name] == ""
            else:
                assert float(cells[name]) == value


@settings(max_examples=30)
@given(st.lists(fleet_rows(), max_size=5))
def test_parquet_has_the_same_with_stamps_for_dates(rows: list[FleetRow]) -> None:
    with folder() as out:
        assert write_parquet(out / "fleet.parquet", rows) == ()
        found = pq.read_table(out / "fleet.parquet").to_pylist()
    assert len(found) == len(rows)
    for cells, each in zip(found, rows, strict=True):
        wanted = flat(each)
        date = str(wanted.pop("date"))
        assert cells.pop("date") == (datetime.fromisoformat(date) if date else None)
        assert cells.keys() == wanted.keys()
        for name, value in wanted.items():
            if isinstance(value, float) and math.isnan(value):
                assert cells[name] is None
            elif isinstance(value, str):
                assert cells[name] == value.encode("utf-8", "replace").decode()
            else:
                assert cells[name] == value


def test_dates_are_in_utc(tmp_path: Path) -> None:
    write_parquet(tmp_path / "f.parquet", [row(2)])
    (cells,) = pq.read_table(tmp_path / "f.parquet").to_pylist()
    assert cells["date"] == datetime(2026, 5, 3, 8, tzinfo=UTC)


def test_a_failed_drive_is_a_row_with_its_reason(tmp_path: Path) -> None:
    failed = FleetRow("truck", "b.bag", "truck/b", "", 0.0, None, "b.bag: truncated")
    write_csv(tmp_path / "f.csv", [failed])
    header, line = (tmp_path / "f.csv").read_text().splitlines()
    assert line.startswith("truck,b.bag,,,error,,b.bag: truncated,")
    assert header.count(",") == line.count(",")


def test_outliers_are_told_in_words() -> None:
    outliers = (Outlier("t_x (mm)", 37.81, 9.94), Outlier("H_z (uT)", -2.0, 5.5))
    told = flat(row(0, outliers=outliers))["outliers"]
    assert told == "t_x +37.8 mm, 9.9 times expected; H_z -2.00 uT, 5.5 times expected"


def test_without_pyarrow_the_line_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "fleet.parquet"
    path.write_bytes(b"of an earlier run")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (line,) = write_parquet(path, [row()])
    assert "pip install 'l2m-gtsam[fleet]'" in line
    assert not path.exists()

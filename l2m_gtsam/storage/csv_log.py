"""Logs and trajectories in CSV with named columns."""

import csv
import warnings
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from itertools import chain, zip_longest
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.errors import BagError, Notice
from l2m_gtsam.storage.bag_options import ColumnOptions, TimeUnit
from l2m_gtsam.storage.csv_columns import Roles, column_roles
from l2m_gtsam.storage.field_types import CSV_FIELD_TYPE
from l2m_gtsam.storage.files import open_text
from l2m_gtsam.storage.log import TableLog, TableTopic
from l2m_gtsam.storage.messages import CSV_POSE_TYPE, Orientation, Position, RawPose
from l2m_gtsam.text import shown

NS_PER = {
    TimeUnit.SECONDS: 1_000_000_000,
    TimeUnit.MILLISECONDS: 1_000_000,
    TimeUnit.MICROSECONDS: 1000,
    TimeUnit.NANOSECONDS: 1,
}
# Seconds since 1970 of our days: the years 2000 and 2100.
OUR_DAYS = (9.46e8, 4.1e9)
# Of times since a start: a magnetometer reads more often than every 5 s, one whose times are whole
# milliseconds or microseconds more often than every second, and none faster than 1 MHz.
STEPS = ((5.0, TimeUnit.SECONDS), (1e3, TimeUnit.MILLISECONDS), (1e6, TimeUnit.MICROSECONDS))
START = datetime(1970, 1, 1, tzinfo=UTC)
LATEST_NS = 9_000_000_000_000_000_000
MAX_COLUMNS = 2000
POSE_TOPIC = "/pose"


@dataclass(frozen=True)
class CsvReading:
    """A row's reading."""

    field: Position


@dataclass(frozen=True)
class NamedColumns:
    """What was read of a table.

    Attributes
    ----------
    roles
        What its columns are.
    stamp_ns
        Times of the rows in nanoseconds, shape (N,).
    values
        By column, each of shape (N,); NaN where a cell is empty.
    """

    roles: Roles
    stamp_ns: IntArray
    values: dict[int, FloatArray]

    def rows(self, columns: Sequence[int]) -> FloatArray:
        """Return some columns side by side, shape (N, K)."""
        return np.column_stack([self.values[column] for column in columns])


def read_csv_log(path: Path, options: ColumnOptions) -> TableLog:
    """Return a table as a log: a topic for each magnetometer, one for the poses.

    Parameters
    ----------
    path
        Names of the columns in the first line, then a row for each reading or pose.
    options
        Which columns are what, where their names do not say it.

    Raises
    ------
    BagError
        The file is missing or no such table; the line of it is named.
    """
    table = read_table(path, options)
    for each in table.roles.left_out:
        warnings.warn(f"{path}: left out: columns {shown(each)}", Notice, stacklevel=2)
    channels = [_readings(table, name) for name in table.roles.fields]
    if table.roles.position is not None and table.roles.orientation is not None:
        channels.append(_poses(table))
    if not channels:
        raise BagError(
            f"{path}: no columns of a magnetometer (as mag_x, mag_y, mag_z) or of poses (x, y, z, "
            "qx, qy, qz, qw) are known by their names; name them with `bag.columns`"
        )
    return TableLog(path, channels)


def read_table(path: Path, options: ColumnOptions) -> NamedColumns:
    """Return the columns of a table that have a meaning; errors as of ``read_csv_log``."""
    with open_text(path, BagError) as file:
        lines = (line for line in file if line.strip())
        head = next(lines, "")
        if not head.strip():
            raise BagError(f"{path}: is empty; expected: a table with the names of columns first")
        separator = _separator(head)
        names = next(csv.reader([head], delimiter=separator, skipinitialspace=True))
        if len(names) > MAX_COLUMNS:
            raise BagError(f"{path}: {len(names)} columns, {MAX_COLUMNS} are accepted")
        if _is_number(names[0]):
            raise BagError(
                f"{path}: its first line is numbers; write the names of the columns there, as "
                "stamp,mag_x,mag_y,mag_z"
            )
        rows: Iterator[list[str]] = csv.reader(lines, delimiter=separator, skipinitialspace=True)
        try:
            first = next(rows, [])
            begin = 3 if _are_groups(names, first) else 2
            if begin == 3:
                names = _with_groups(names, first)
            elif first:
                rows = chain([first], rows)
            roles = column_roles(names, options, path.stem)
        except csv.Error as error:
            raise BagError(f"{path}: not a table in CSV: {error}") from error
        except ValueError as error:
            raise BagError(f"{path}: {error}") from error
        return _read(path, roles, rows, begin)


def _are_groups(names: Sequence[str], below: Sequence[str]) -> bool:
    """Return whether a line stands over names of axes: what columns have in common."""
    return not any(map(_is_number, below)) and any(
        not name and axis for name, axis in zip(names, below, strict=False)
    )


def _with_groups(names: Sequence[str], below: Sequence[str]) -> list[str]:
    """Return names of columns of two lines, of which the upper names several columns at once."""
    found, group = [], ""
    for name, axis in zip_longest(names, below, fillvalue=""):
        group = name or group
        found.append(f"{group} {axis}".strip())
    return found


def _separator(head: str) -> str:
    return max(",;\t", key=head.count) if any(each in head for each in ",;\t") else " "


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read(path: Path, roles: Roles, rows: Iterator[list[str]], begin: int) -> NamedColumns:
    """Return the columns that have a meaning, of rows from a line on."""
    fields = [each.columns for each in roles.fields.values()]
    wanted = sorted({*chain(*fields), *(roles.position or ()), *(roles.orientation or ())})
    values = {column: array("d") for column in wanted}
    stamps: list[tuple[str, ...]] = []
    most = max([*wanted, *roles.stamp])
    try:
        for number, row in enumerate(rows, start=begin):
            if len(row) <= most:
                raise BagError(
                    f"{path}: line {number} has {len(row)} columns, {most + 1} are needed; it may "
                    "be truncated"
                )
            stamps.append(tuple(row[column] for column in roles.stamp))
            for column, numbers in values.items():
                cell = row[column]
                try:
                    numbers.append(float(cell) if cell else float("nan"))
                except ValueError:
                    raise BagError(f"{path}: line {number}: {cell[:40]!r} is no number") from None
    except csv.Error as error:
        raise BagError(f"{path}: not a table in CSV: {error}") from error
    if not stamps:
        raise BagError(f"{path}: no rows below the names of the columns")
    stamp_ns = _nanoseconds(path, stamps, roles.time_unit, begin)
    return NamedColumns(
        roles, stamp_ns, {c: np.array(v, dtype=np.float64) for c, v in values.items()}
    )


def _nanoseconds(path: Path, stamps: list[tuple[str, ...]], unit: TimeUnit, begin: int) -> IntArray:
    """Return times in nanoseconds; in integers, which a double cannot hold."""
    if len(stamps[0]) == 1 and _date_ns(stamps[0][0]) is not None:
        return _dates(path, [words[0] for words in stamps], begin)
    if unit is TimeUnit.AUTO:
        unit = _likely_unit(stamps)
    factors = (NS_PER[unit], 1)
    found = array("q")
    for number, words in enumerate(stamps, start=begin):
        try:
            exact = sum(round(Decimal(w) * f) for w, f in zip(words, factors, strict=False))
        except (InvalidOperation, ValueError, OverflowError):
            raise BagError(f"{path}: line {number}: {words[0][:40]!r} is no time") from None
        if not 0 <= exact < LATEST_NS:
            raise BagError(
                f"{path}: line {number}: {words[0][:40]!r} is no time in {unit.value}; name the "
                "unit with `columns.time_unit`"
            )
        found.append(exact)
    return np.array(found, dtype=np.int64)


def _dates(path: Path, words: Sequence[str], begin: int) -> IntArray:
    """Return dates with times of day in nanoseconds since 1970, shape (N,)."""
    found = array("q")
    for number, word in enumerate(words, start=begin):
        nanoseconds = _date_ns(word)
        if nanoseconds is None:
            raise BagError(f"{path}: line {number}: {word[:40]!r} is no date and time of day")
        found.append(nanoseconds)
    return np.array(found, dtype=np.int64)


def _date_ns(word: str) -> int | None:
    """Return a date with a time of day, UTC where it has no zone; None for a number and others."""
    if _is_number(word):
        return None
    try:
        date = datetime.fromisoformat(word.strip())
    except ValueError:
        return None
    known = date if date.tzinfo is not None else date.replace(tzinfo=UTC)
    nanoseconds = 1000 * ((known - START) // timedelta(microseconds=1))
    return nanoseconds if 0 <= nanoseconds < LATEST_NS else None


def _likely_unit(stamps: list[tuple[str, ...]]) -> TimeUnit:
    """Return the unit that makes a date of our days of the times, else a likely rate."""
    try:
        times = np.array([float(words[0]) for words in stamps[:10_000]])
    except ValueError:
        return TimeUnit.SECONDS
    first, last = OUR_DAYS
    for unit, nanoseconds in NS_PER.items():
        if first <= times[0] * nanoseconds / NS_PER[TimeUnit.SECONDS] < last:
            return unit
    steps = np.diff(np.unique(times))
    typical = float(np.median(steps)) if len(steps) else 0.0
    return next((unit for most, unit in STEPS if typical < most), TimeUnit.NANOSECONDS)


def _readings(table: NamedColumns, name: str) -> TableTopic:
    """Return the readings of a magnetometer; rows without any of its numbers are left out."""
    columns = table.roles.fields[name]
    values = table.rows(columns.columns)
    kept = ~np.isnan(values).all(axis=1)
    rows = values[kept]

    def contents() -> Iterator[CsvReading]:
        return (CsvReading(Position(*row)) for row in rows.tolist())

    return TableTopic(f"/{name}", CSV_FIELD_TYPE, table.stamp_ns[kept], contents, columns.unit)


def _poses(table: NamedColumns) -> TableTopic:
    """Return the poses of the rows that have one."""
    values = table.rows([*(table.roles.position or ()), *(table.roles.orientation or ())])
    kept = ~np.isnan(values).any(axis=1)
    rows = values[kept]

    def contents() -> Iterator[RawPose]:
        return (RawPose(Position(*row[:3]), Orientation(*row[3:]), "") for row in rows.tolist())

    return TableTopic(POSE_TOPIC, CSV_POSE_TYPE, table.stamp_ns[kept], contents)

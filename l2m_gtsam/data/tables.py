"""Tables of arrays: rows are joined and chosen as those of an array."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Self, TypeVar

import numpy as np

from l2m_gtsam.data.arrays import BoolArray, IntArray

Table = TypeVar("Table")


def joined_rows(parts: Sequence[Table]) -> Table:
    """Return tables of arrays as one, the rows of each after those of the one before.

    Parameters
    ----------
    parts
        At least one, all of one dataclass. Its fields are arrays with a value for each row, such
        tables themselves, or the same in all parts. What one part lacks, all lack.
    """

    def column(values: Sequence[Any]) -> Any:
        if any(each is None for each in values):
            return None
        if is_dataclass(values[0]):
            return joined_rows(values)
        return np.concatenate(values) if isinstance(values[0], np.ndarray) else values[0]

    first: Any = parts[0]
    names = [each.name for each in fields(first)]
    whole: Table = type(first)(*(column([getattr(e, name) for e in parts]) for name in names))
    return whole


def chosen_rows(table: Table, rows: IntArray | BoolArray) -> Table:
    """Return chosen rows of a table of arrays as in ``joined_rows``."""

    def chosen(values: Any) -> Any:
        if is_dataclass(values):
            return chosen_rows(values, rows)
        return values[rows] if isinstance(values, np.ndarray) else values

    whole: Any = table
    part: Table = type(whole)(*(chosen(getattr(whole, each.name)) for each in fields(whole)))
    return part


class RowTable:
    """A table of arrays whose rows are chosen as those of an array."""

    def __getitem__(self, rows: IntArray | BoolArray) -> Self:
        return chosen_rows(self, rows)


class TimedTable(RowTable):
    """One with a time for each row."""

    stamp_ns: IntArray

    def __len__(self) -> int:
        return len(self.stamp_ns)

"""What all records that are files have in common: numbers as JSON has them, arrays that fit."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from types import GenericAlias
from typing import Any, ClassVar, get_args

import numpy as np
from pydantic import ConfigDict, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

Row = tuple[float, ...]
Rows = tuple[Row, ...]

# Squares and sums of such numbers are finite; no quantity is nearly as large in any unit.
LARGEST = 1e30
HUGE = 10**300  # that integers are taken for which are no floats


def _fits(value: Sequence[Any], shape: Sequence[str], lengths: dict[str, int]) -> bool:
    """Return whether rows in rows have a shape; letters that have no length yet get one."""
    letter, _, more = shape[0].partition("+")
    if letter.isdigit():
        expected = int(letter)
    else:
        expected = lengths.setdefault(letter, len(value) - int(more or 0)) + int(more or 0)
    if len(value) != expected:
        return False
    return len(shape) == 1 or all(_fits(row, shape[1:], lengths) for row in value)


def _largest(value: Any) -> float:
    """Return the largest finite number in rows of rows."""
    try:
        sizes = np.abs(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError, OverflowError):  # rows of different lengths, or no numbers
        return _largest_of_each(value)
    return float(np.max(sizes, where=np.isfinite(sizes), initial=0.0))


def _largest_of_each(value: Any) -> float:
    """Return the same, number by number."""
    if isinstance(value, tuple | list):
        return max(map(_largest_of_each, value), default=0.0)
    if isinstance(value, int):
        return float(min(abs(value), HUGE))
    return abs(value) if isinstance(value, float) and math.isfinite(value) else 0.0


@dataclass(frozen=True)
class Shape:
    """Of an array in a field, as `N 3`: letters are lengths that arrays share, `N+1` is one more.

    ``of`` names an array of the record that is in the field.
    """

    text: str
    of: str = ""


@dataclass(frozen=True)
class Record:
    """A part of a file in JSON; numbers that are not finite are text there."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(ser_json_inf_nan="strings")

    def __post_init__(self) -> None:
        """Raise a ValueError for arrays whose shapes do not fit together, or with odd numbers."""
        lengths: dict[str, int] = {}
        for name, shape in self._shapes():
            value = getattr(self, name)
            if shape.of and value is not None:
                name, value = f"{name}.{shape.of}", getattr(value, shape.of)
            if value is not None and not _fits(value, shape.text.split(), lengths):
                known = ", ".join(f"{letter} = {length}" for letter, length in lengths.items())
                where = f" with {known}" if known else ""
                raise ValueError(f"{name} must have the shape ({shape.text}){where}")
            if (largest := _largest(value)) > LARGEST:
                raise ValueError(f"{name} has {largest:.3g}, at most {LARGEST:g} can be")

    @classmethod
    @cache
    def _shapes(cls) -> tuple[tuple[str, Shape], ...]:
        """Return the shapes of fields by their names, one more after what it is one more than."""
        found = [
            (each.name, shape)
            for each in fields(cls)
            for shape in getattr(each.type, "__metadata__", ())
            if isinstance(shape, Shape)
        ]
        return tuple(sorted(found, key=lambda each: "+" in each[1].text))


def fields_of(record: object, kind: type[Any]) -> dict[str, Any]:
    """Return the fields of a dataclass that it has from one of its base classes, by name."""
    return {each.name: getattr(record, each.name) for each in fields(kind)}


@dataclass(frozen=True)
class KeyedBy:
    """How pydantic reads and writes a tuple of records: as a mapping from one of their fields."""

    name: str

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        entries_type = GenericAlias(dict, (str, get_args(source)[0]))
        entries = core_schema.no_info_before_validator_function(
            self._with_names, handler.generate_schema(entries_type)
        )
        return core_schema.no_info_after_validator_function(
            lambda found: tuple(found.values()),
            entries,
            serialization=core_schema.wrap_serializer_function_ser_schema(
                self._by_name, schema=handler.generate_schema(source)
            ),
        )

    def _with_names(self, entries: Any) -> Any:
        """Return entries with their names inside; what is no mapping is refused afterwards."""
        if not isinstance(entries, dict):
            return entries
        return {
            name: {**entry, self.name: name} if isinstance(entry, dict) else entry
            for name, entry in entries.items()
        }

    def _by_name(self, records: Any, dump: Callable[[Any], list[dict[str, Any]]]) -> Any:
        return {entry.pop(self.name): entry for entry in dump(records)}

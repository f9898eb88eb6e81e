"""Dataclasses as plain arrays, column by column, and back: their type hints say how.

A field of all values is one array, so that thousands of key poses are tens of arrays. The names say
where each belongs, as ``state.intake.poses[].stamp_ns``; what is beside the numbers has a mark:

| mark | of n values |
|---|---|
| ``?`` | which of them are not None, (n,) |
| ``#`` | how many elements each has, (n,) |
| ``:`` | the shape of each array, (n, axes) |

Arrays that are read are not trusted: each has to be of the type and length that is due, so that no
more is made than there is in the file.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import pairwise
from math import prod
from operator import attrgetter, itemgetter
from types import GenericAlias, NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import gtsam
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

Arrays = dict[str, npt.NDArray[Any]]
Bytes = npt.NDArray[np.uint8]
NUMBERS: dict[type, type] = {int: np.int64, float: np.float64, bool: np.bool_}


def packed(kind: Any, values: Sequence[Any], name: str) -> Arrays:
    """Return n values as arrays.

    Parameters
    ----------
    kind
        Their type: a dataclass, a type with None, tuple, list, frozenset or dict, an array, int,
        float, bool, text or an enumeration of texts, a model of pydantic, ``gtsam.Pose3``.
    values
        The n values.
    name
        With which the names of the arrays begin.
    """
    if form := _form(kind):
        return packed(form.kind, [form.of(each) for each in values], name)
    own, inner = get_origin(kind), get_args(kind)
    if own is UnionType:
        there = [each for each in values if each is not None]
        mask = {f"{name}?": np.array([each is not None for each in values], dtype=np.bool_)}
        # A type may hold itself: where there is none, the description ends.
        return mask | (packed(_not_none(inner), there, name) if there else {})
    if _is_several(own, inner):
        counts = np.array([len(each) for each in values], dtype=np.int64)
        flat = [each for every in values for each in every]
        return {f"{name}#": counts} | packed(inner[0], flat, f"{name}[]")
    if own is np.ndarray:
        flat = [np.ravel(each) for each in values]
        dtype = _dtype(inner)
        return {
            f"{name}:": np.array([np.shape(each) for each in values], dtype=np.int64),
            name: np.concatenate(flat, dtype=dtype) if flat else np.empty(0, dtype),
        }
    if kind in NUMBERS:
        return {name: np.array(values, dtype=NUMBERS[kind])}
    arrays: Arrays = {}
    for part in _parts(kind):
        arrays |= packed(part.kind, [part.of(each) for each in values], f"{name}.{part.name}")
    return arrays


def unpacked(kind: Any, arrays: Arrays, count: int, name: str) -> list[Any]:
    """Return the values of ``packed``, of which there are ``count``.

    Raises
    ------
    KeyError, ValueError, TypeError, RuntimeError, OverflowError
        The arrays are not those of such values.
    """
    if form := _form(kind):
        return [form.back(each) for each in unpacked(form.kind, arrays, count, name)]
    own, inner = get_origin(kind), get_args(kind)
    if own is UnionType:
        there = _column(arrays, f"{name}?", np.bool_, count)
        found = iter(unpacked(_not_none(inner), arrays, sum(there), name) if any(there) else ())
        return [next(found) if each else None for each in there]
    if _is_several(own, inner):
        ends = _ends(_column(arrays, f"{name}#", np.int64, count))
        flat = unpacked(inner[0], arrays, ends[-1], f"{name}[]")
        return [own(flat[begin:end]) for begin, end in pairwise(ends)]
    if own is np.ndarray:
        shapes, numbers = _shapes(arrays[f"{name}:"], name, count), arrays[name]
        ends = _ends([prod(each) for each in shapes])
        _require(numbers, name, _dtype(inner), ends[-1])
        rows = zip(pairwise(ends), shapes, strict=True)
        return [numbers[begin:end].reshape(shape) for (begin, end), shape in rows]
    if kind in NUMBERS:
        return _column(arrays, name, NUMBERS[kind], count)
    columns = [unpacked(each.kind, arrays, count, f"{name}.{each.name}") for each in _parts(kind)]
    rows = zip(*columns, strict=True)
    return list(rows) if own is tuple else [kind(*row) for row in rows]


@dataclass(frozen=True)
class _Form:
    """Another type in which values of a type are kept, and how they get there and back."""

    kind: Any
    of: Callable[[Any], Any]
    back: Callable[[Any], Any]


def _form(kind: Any) -> _Form | None:
    own, inner = get_origin(kind), get_args(kind)
    if own is dict:
        pairs = GenericAlias(list, (GenericAlias(tuple, inner),))
        return _Form(pairs, lambda each: list(each.items()), dict)
    if own is frozenset:  # in one order, so that the same state gives the same bytes
        return _Form(GenericAlias(list, inner), sorted, frozenset)
    if kind is gtsam.Pose3:
        return _Form(npt.NDArray[np.float64], gtsam.Pose3.matrix, gtsam.Pose3)
    if own is None and issubclass(kind, BaseModel):
        return _Form(
            str,
            lambda each: json.dumps(each.model_dump(mode="json")),
            lambda text: kind.model_validate(json.loads(text)),
        )
    if own is None and issubclass(kind, str):
        return _Form(
            Bytes,
            lambda each: np.frombuffer(str(each).encode(), dtype=np.uint8),
            lambda each: kind(each.tobytes().decode()),
        )
    return None


@dataclass(frozen=True)
class _Part:
    """A field of a dataclass, or a place of a tuple: its name, its type and how it is had."""

    name: str
    kind: Any
    of: Callable[[Any], Any]


@cache
def _parts(kind: Any) -> tuple[_Part, ...]:
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return tuple(
            _Part(each.name, hints[each.name], attrgetter(each.name)) for each in fields(kind)
        )
    if get_origin(kind) is tuple:
        return tuple(_Part(str(k), each, itemgetter(k)) for k, each in enumerate(get_args(kind)))
    raise TypeError(f"{kind} cannot be kept as arrays")


def _is_several(own: Any, inner: tuple[Any, ...]) -> bool:
    """Return whether a type is of any number of elements of one type."""
    return own is list or (own is tuple and inner[-1] is ...)


def _not_none(inner: tuple[Any, ...]) -> Any:
    (kind,) = (each for each in inner if each is not NoneType)
    return kind


def _dtype(inner: tuple[Any, ...]) -> Any:
    """Return the type of the numbers of an array, of the arguments of its own type."""
    return get_args(inner[1])[0]


def _column(arrays: Arrays, name: str, dtype: type, count: int) -> list[Any]:
    array = arrays[name]
    _require(array, name, dtype, count)
    found: list[Any] = array.tolist()
    return found


def _require(array: npt.NDArray[Any], name: str, dtype: type, count: int) -> None:
    if array.dtype != dtype or array.shape != (count,):
        raise ValueError(f"{name}: {array.dtype} of {array.shape}; due is {dtype} of {count}")


def _shapes(array: npt.NDArray[Any], name: str, count: int) -> list[list[int]]:
    sound = array.dtype == np.int64 and len(array) == count and array.min(initial=0) >= 0
    if not sound:
        raise ValueError(f"{name}: {array.dtype} of {array.shape}; due are {count} shapes")
    found: list[list[int]] = array.tolist()
    return found


def _ends(counts: list[int]) -> list[int]:
    """Return where each of several stretches begins, and the end of the last."""
    ends = [0]
    for each in counts:
        if each < 0:
            raise ValueError(f"a stretch of {each}")
        ends.append(ends[-1] + each)
    return ends

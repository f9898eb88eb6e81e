"""The base of every options model: frozen, documented field by field, unknown keys refused."""

import ast
import inspect
from collections.abc import Collection, Mapping
from functools import cache
from itertools import pairwise
from math import hypot
from textwrap import dedent
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

UNIT = 1e-3  # a quaternion given to three digits is as long as this
Components = tuple[float, float, float, float]


def _of_unit_length(quaternion: Components) -> Components:
    if abs(hypot(*quaternion) - 1) > UNIT:
        raise ValueError(f"must have length 1, this one has {hypot(*quaternion):.4g}")
    return quaternion


def _not_zero(quaternion: Components) -> Components:
    if not any(quaternion):
        raise ValueError("is all zero, it must be a rotation")
    return quaternion


UnitQuaternion = Annotated[Components, AfterValidator(_of_unit_length)]
"""A rotation as x, y, z, w."""
AnyQuaternion = Annotated[Components, AfterValidator(_not_zero)]
"""The same, of any length but zero."""


class Options(BaseModel):
    """Options that stand beside their algorithm; ``config.py`` only composes them."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


@cache
def meanings(model: type[BaseModel]) -> Mapping[str, str]:
    """Return the docstring of each option of a model, those of its bases included.

    Read from the source when they are asked for: for all models together that takes a tenth of a
    second, at every start of a program that seldom asks.
    """
    found: dict[str, str] = {}
    for each in reversed(model.__mro__):
        if issubclass(each, BaseModel) and each.__module__ != BaseModel.__module__:
            found |= _docstrings(each)
    return found


def _docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return the strings that stand below the fields of a class."""
    (body,) = ast.parse(dedent(inspect.getsource(model))).body
    lines = body.body if isinstance(body, ast.ClassDef) else []
    return {
        field.target.id: inspect.cleandoc(text)
        for field, below in pairwise(lines)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
        and isinstance(text := below.value.value, str)
    }


def named_fault(error: ValidationError) -> ErrorDetails:
    """Return the first fault; an unknown key before what is missing in its place."""
    faults = error.errors()
    unknown = (fault for fault in faults if fault["type"] == "extra_forbidden")
    return next(unknown, faults[0]) if faults[0]["type"] == "missing" else faults[0]


def first_fault(error: ValidationError, *above: str, hidden: Collection[str] = ()) -> str:
    """Return the first fault as the path of its key, and what is wrong with it.

    Parameters
    ----------
    error
        What pydantic raises.
    above
        Keys above those that were checked.
    hidden
        Levels that a file does not have.
    """
    fault = named_fault(error)
    keys = (*above, *(str(part) for part in fault["loc"] if part not in hidden))
    return f"{'.'.join(keys) or 'the file'}: {words_of(fault)}"


WORDS = {
    "tuple_type": "a list is expected",
    "list_type": "a list is expected",
    "dict_type": "names with values are expected",
    "model_type": "names with values are expected",
    "model_attributes_type": "names with values are expected",
    "dataclass_type": "names with values are expected",
    "string_type": "text is expected; put numbers and dates in quotes",
}


def words_of(fault: ErrorDetails) -> str:
    """Return what is wrong in words of this project, or else in those of pydantic."""
    return WORDS.get(fault["type"], fault["msg"].removeprefix("Value error, "))

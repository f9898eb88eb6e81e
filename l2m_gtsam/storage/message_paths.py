"""Values inside messages by the names that lead to them: `current`, `twist.linear.x`, `data[2]`."""

import re
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

STEP = re.compile(r"(\w+)(?:\[(\d+)\])?", re.ASCII)


@dataclass(frozen=True)
class Step:
    """One name of a path, and the index after it if there is one."""

    name: str
    index: int | None

    def __str__(self) -> str:
        return self.name if self.index is None else f"{self.name}[{self.index}]"


def steps_of(dotted: str) -> tuple[Step, ...]:
    """Return the steps of a path; none of an empty one, which is the message itself."""
    found = (STEP.fullmatch(part) for part in dotted.split("."))
    return tuple(Step(m[1], None if m[2] is None else int(m[2])) for m in found if m)


def dotted(steps: tuple[Step, ...]) -> str:
    """Return a path as it is written."""
    return ".".join(str(step) for step in steps)


def value_at(content: Any, steps: tuple[Step, ...]) -> Any:
    """Return what a path leads to.

    Raises
    ------
    ValueError
        There is no such path in the message; what there is instead is named.
    """
    value, name = content, "it"
    for step in steps:
        if step.name not in _names(value):
            raise ValueError(f"has no {dotted(steps)!r}: {name} {described(value)}")
        value, name = getattr(value, step.name), repr(step.name)
        if step.index is not None:
            if not isinstance(value, list | np.ndarray) or step.index >= len(value):
                raise ValueError(f"has no {dotted(steps)!r}: {name} {described(value)}")
            value = value[step.index]
    return value


def number_at(content: Any, steps: tuple[Step, ...]) -> float:
    """Return the number at the end of a path; a ValueError if there is none."""
    value = value_at(content, steps)
    if not isinstance(value, int | float | np.number | np.bool_):
        raise ValueError(f"has no number in {dotted(steps)!r}: it {described(value)}")
    return float(value)


def vector_at(content: Any, steps: tuple[Step, ...]) -> tuple[float, float, float]:
    """Return the three numbers at the end of a path: x, y and z, or an array of three.

    Raises
    ------
    ValueError
        There is no such path, or no such numbers at its end.
    """
    value = value_at(content, steps)
    try:
        if isinstance(value, list | np.ndarray):
            x, y, z = value
        else:
            x, y, z = value.x, value.y, value.z
        return float(x), float(y), float(z)
    except (AttributeError, TypeError, ValueError) as error:
        where = f" in {dotted(steps)!r}" if steps else ""
        raise ValueError(f"has no x, y and z{where}: it {described(value)}") from error


def described(value: Any) -> str:
    """Return what a value is instead of what it should be."""
    if isinstance(value, list | np.ndarray):
        return f"has {len(value)} elements, of which [0] is the first"
    if names := _names(value):
        return f"has the fields {', '.join(names[:20])}"
    return "is a text" if isinstance(value, str) else "is a single number"


def _names(value: Any) -> tuple[str, ...]:
    """Return the fields of a message, without the constants of its type; none of anything else."""
    if not is_dataclass(value):
        return ()
    return tuple(each.name for each in fields(value) if "ClassVar" not in str(each.type))

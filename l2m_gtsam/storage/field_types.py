"""Where magnetic readings are in messages: a table of types, or a path that the options name."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.storage.units import Unit

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


FIELD_TYPE = "sensor_msgs/msg/MagneticField"
VECTOR_TYPE = "geometry_msgs/msg/Vector3Stamped"
PX4_TYPE = "px4_msgs/msg/VehicleMagnetometer"
PX4_RAW_TYPE = "px4_msgs/msg/SensorMag"
CSV_FIELD_TYPE = "csv/Field"


@dataclass(frozen=True)
class FieldType:
    """A type of message with a magnetic reading in it.

    Attributes
    ----------
    path
        Where the vector is; empty where the message itself has x, y and z.
    unit
        Unit that the type prescribes; absent where it prescribes none.
    rank
        Unless topics are named, those of the lowest rank in a log are read: of one device, a
        driver often publishes several.
    by_name
        Whether a topic is only taken for a magnetometer's if its name says so.
    """

    path: str
    unit: Unit | None
    rank: int
    by_name: bool = False


FIELD_TYPES: dict[str, FieldType] = {
    FIELD_TYPE: FieldType("magnetic_field", Unit.TESLA, 0),
    PX4_TYPE: FieldType("magnetometer_ga", Unit.GAUSS, 1),
    "vectornav_msgs/msg/CommonGroup": FieldType("magpres_mag", Unit.GAUSS, 1),
    "sbg_driver/msg/SbgMag": FieldType("mag", None, 1),
    CSV_FIELD_TYPE: FieldType("field", None, 1),
    PX4_RAW_TYPE: FieldType("", Unit.GAUSS, 2),
    "vectornav_msgs/msg/ImuGroup": FieldType("mag", Unit.GAUSS, 2),
    VECTOR_TYPE: FieldType("vector", None, 3, by_name=True),
}
"""The types that are known, by ROS' name of each."""


@dataclass(frozen=True)
class FieldSource:
    """A topic with magnetic readings, and where they are in its messages.

    Attributes
    ----------
    connection
        Of the log.
    label
        What it is called: the topic, with the path after it where the options name one.
    path
        Where the vector is in a message.
    unit
        Unit that its type prescribes, if it does.
    """

    connection: Connection
    label: str
    path: str
    unit: Unit | None

    @cached_property
    def _vector(self) -> Callable[[Any], Any]:
        return attrgetter(self.path) if self.path and "[" not in self.path else _itself

    def reading(self, content: Any) -> tuple[float, float, float]:
        """Return the reading of a message; a ValueError if it has none there."""
        try:
            vector = self._vector(content)
            return vector.x, vector.y, vector.z
        except AttributeError:
            return vector_at(content, steps_of(self.path))


def _itself(content: Any) -> Any:
    return content


def field_source(connection: Connection) -> FieldSource:
    """Return where the readings of a topic of a known type are."""
    kind = FIELD_TYPES[connection.msgtype]
    unit = stated_unit(connection) or kind.unit
    return FieldSource(connection, connection.topic, kind.path, unit)


def stated_unit(connection: Connection) -> Unit | None:
    """Return the unit that a log states for a topic, as columns of a table may."""
    stated = getattr(connection.ext, "unit", None)
    return stated if isinstance(stated, Unit) else None


def named_source(connection: Connection, path: str) -> FieldSource:
    """Return where the readings of a topic of any type are, by a path."""
    return FieldSource(connection, f"{connection.topic}:{path}", path, None)


def by_connection(sources: Sequence[FieldSource]) -> dict[int, list[FieldSource]]:
    """Return sources by the number of their connection: of a topic there may be several."""
    found: dict[int, list[FieldSource]] = {}
    for source in sources:
        found.setdefault(source.connection.id, []).append(source)
    return found


def is_field(connection: Connection) -> bool:
    """Return whether a topic is taken for a magnetometer's unless the options say otherwise."""
    kind = FIELD_TYPES.get(connection.msgtype)
    return kind is not None and (not kind.by_name or "mag" in connection.topic.lower())

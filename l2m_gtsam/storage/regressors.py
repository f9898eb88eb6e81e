"""Read numbers out of a bag that go along with a drive: currents, speeds, duty cycles."""

import re
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.data import ScalarSeries
from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag_options import RegressorTopic, Stamps
from l2m_gtsam.storage.messages import header_ns
from l2m_gtsam.storage.open_bag import Bag, Message, open_bag
from l2m_gtsam.storage.selection import listed

STEP = re.compile(r"(\w+)(?:\[(\d+)\])?", re.ASCII)


@dataclass(frozen=True)
class _Step:
    """One name of a path, and the index after it if there is one."""

    name: str
    index: int | None

    def __str__(self) -> str:
        return self.name if self.index is None else f"{self.name}[{self.index}]"


@dataclass
class _NumberBuffer:
    """The numbers of one regressor as they come."""

    name: str
    options: RegressorTopic
    steps: tuple[_Step, ...]
    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))


def read_scalars(
    path: Path,
    options: Mapping[str, RegressorTopic],
    stamps: Stamps = Stamps.HEADER,
    progress: Count | None = None,
) -> tuple[ScalarSeries, ...]:
    """Read the numbers that options name, in one pass; other topics are not decoded.

    The stamp is that of the message's header, the record time where it has none. Numbers that are
    not finite are dropped, and of several with one stamp all but the first.

    Parameters
    ----------
    path
        Bag of any kind.
    options
        Where each number is found, by its name.
    stamps
        Which time of a message counts, as for the readings.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        The bag, a topic or a field is not usable; the line says what there is instead.
    """
    if not options:
        return ()
    collected = [_NumberBuffer(name, each, _steps(each.field)) for name, each in options.items()]
    with open_bag(path) as bag:
        topics = {_topic(bag, each) for each in collected}
        connections = [c for c in bag.connections if c.topic.lstrip("/") in topics]
        for message in bag.messages(connections, progress):
            stamp_ns = _stamp(message, stamps)
            for each in collected:
                if _plain(each.options.topic) == message.connection.topic.lstrip("/"):
                    _add(path, each, stamp_ns, message)
    return tuple(_series(path, each) for each in collected)


def _steps(dotted: str) -> tuple[_Step, ...]:
    found = (STEP.fullmatch(part) for part in dotted.split("."))
    return tuple(_Step(m[1], None if m[2] is None else int(m[2])) for m in found if m)


def _plain(topic: str) -> str:
    return topic.lstrip("/")


def _topic(bag: Bag, wanted: _NumberBuffer) -> str:
    """Return a regressor's topic without its leading slash; the bag must have it."""
    topic = _plain(wanted.options.topic)
    if all(_plain(c.topic) != topic for c in bag.connections):
        raise BagError(
            f"{bag.path}: regressor {wanted.name!r}: no topic {wanted.options.topic!r}; there are: "
            f"{listed(bag.connections)}"
        )
    return topic


def _stamp(message: Message, stamps: Stamps) -> int:
    header = getattr(message.content, "header", None)
    if stamps is Stamps.RECORD or not hasattr(header, "stamp"):
        return message.record_ns
    return header_ns(message.content)


def _add(path: Path, into: _NumberBuffer, stamp_ns: int, message: Message) -> None:
    """Append the number of one message."""
    try:
        value = _number(message.content, into.steps)
    except ValueError as error:
        raise BagError(
            f"{path}: regressor {into.name!r}: {message.connection.msgtype} on "
            f"{message.connection.topic} {error}"
        ) from error
    into.stamp_ns.append(stamp_ns)
    into.values.append(value)


def _number(content: Any, steps: tuple[_Step, ...]) -> float:
    """Return the number at the end of a path.

    Raises
    ------
    ValueError
        There is no such path, or no number at its end.
    """
    value, name = content, "it"
    for step in steps:
        if step.name not in _names(value):
            raise ValueError(f"has no {_dotted(steps)!r}: {name} {_described(value)}")
        value, name = getattr(value, step.name), repr(step.name)
        if step.index is not None:
            if not isinstance(value, list | np.ndarray) or step.index >= len(value):
                raise ValueError(f"has no {_dotted(steps)!r}: {name} {_described(value)}")
            value = value[step.index]
    if not isinstance(value, int | float | np.number | np.bool_):
        raise ValueError(f"has no number in {_dotted(steps)!r}: it {_described(value)}")
    return float(value)


def _names(value: Any) -> tuple[str, ...]:
    """Return the fields of a message, without the constants of its type; none of anything else."""
    if not is_dataclass(value):
        return ()
    return tuple(each.name for each in fields(value) if "ClassVar" not in str(each.type))


def _dotted(steps: tuple[_Step, ...]) -> str:
    return ".".join(str(step) for step in steps)


def _described(value: Any) -> str:
    """Return what a value is instead of what it should be."""
    if isinstance(value, list | np.ndarray):
        return f"has {len(value)} elements, of which [0] is the first"
    if names := _names(value):
        return f"has the fields {', '.join(names[:20])}"
    return "is a text" if isinstance(value, str) else "is a single number"


def _series(path: Path, found: _NumberBuffer) -> ScalarSeries:
    """Return the finite numbers in order of time, the first of each stamp."""
    value = np.array(found.values, dtype=np.float64) * found.options.scale
    stamp_ns = np.array(found.stamp_ns, dtype=np.int64)
    where = f"{path}: regressor {found.name!r}: topic {found.options.topic}"
    if len(stamp_ns) and not stamp_ns.any():
        raise BagError(
            f"{where}: all header stamps are 0; use the record time instead with "
            "`bag.stamps: record`"
        )
    finite = np.isfinite(value)
    if not finite.any():
        what = f"no finite {found.options.field!r}" if len(value) else "no messages"
        raise BagError(f"{where} has {what}")
    stamp_ns, first = np.unique(stamp_ns[finite], return_index=True)
    return ScalarSeries(found.name, found.options.topic, stamp_ns, value[finite][first])

"""Read numbers out of a bag that go along with a drive: currents, speeds, duty cycles."""

from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.data import ScalarSeries
from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag_options import BagOptions, RegressorTopic
from l2m_gtsam.storage.clocks import check_stamps
from l2m_gtsam.storage.field_types import Step, number_at, steps_of
from l2m_gtsam.storage.log import Message
from l2m_gtsam.storage.open_log import Log, open_log
from l2m_gtsam.storage.selection import listed


@dataclass
class _NumberBuffer:
    """The numbers of one regressor as they come."""

    name: str
    options: RegressorTopic
    steps: tuple[Step, ...]
    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    values: "array[float]" = field(default_factory=lambda: array("d"))


def read_scalars(
    path: Path, options: BagOptions, progress: Count | None = None
) -> tuple[ScalarSeries, ...]:
    """Read the numbers that options name, in one pass; other topics are not decoded.

    The stamp is that of the message's header, the record time where it has none. Numbers that are
    not finite are dropped, and of several with one stamp all but the first.

    Parameters
    ----------
    path
        Bag of any kind.
    options
        Where each number is found, by its name, and which time of a message counts.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        The bag, a topic or a field is not usable; the line says what there is instead.
    """
    if not options.regressors:
        return ()
    collected = [
        _NumberBuffer(name, each, steps_of(each.field)) for name, each in options.regressors.items()
    ]
    with open_log(path, options.columns) as bag:
        into: dict[int, list[_NumberBuffer]] = {}
        for each in collected:
            for connection in _connections(bag, each):
                into.setdefault(connection.id, []).append(each)
        connections = [c for c in bag.connections if c.id in into]
        for message in bag.messages(connections, progress):
            for each in into[message.connection.id]:
                _add(path, each, message.stamp_ns(options.stamps), message)
    return tuple(_series(path, each) for each in collected)


def _connections(bag: Log, wanted: _NumberBuffer) -> list[Connection]:
    """Return those of a regressor's topic, whatever its leading slash; the bag must have one."""
    topic = wanted.options.topic
    found = [c for c in bag.connections if c.topic.lstrip("/") == topic.lstrip("/")]
    if not found:
        raise BagError(
            f"{bag.path}: regressor {wanted.name!r}: no topic {topic!r}; there are: "
            f"{listed(bag.connections)}"
        )
    return found


def _add(path: Path, into: _NumberBuffer, stamp_ns: int, message: Message) -> None:
    """Append the number of one message."""
    try:
        value = number_at(message.content, into.steps)
    except ValueError as error:
        raise BagError(
            f"{path}: regressor {into.name!r}: {message.connection.msgtype} on "
            f"{message.connection.topic} {error}"
        ) from error
    into.stamp_ns.append(stamp_ns)
    into.values.append(value)


def _series(path: Path, found: _NumberBuffer) -> ScalarSeries:
    """Return the finite numbers in order of time, the first of each stamp."""
    value = np.array(found.values, dtype=np.float64) * found.options.scale
    stamp_ns = np.array(found.stamp_ns, dtype=np.int64)
    what = f"regressor {found.name!r}: topic {found.options.topic}"
    check_stamps(path, what, stamp_ns)
    finite = np.isfinite(value)
    if not finite.any():
        there = f"no finite {found.options.field!r}" if len(value) else "no messages"
        raise BagError(f"{path}: {what} has {there}")
    stamp_ns, first = np.unique(stamp_ns[finite], return_index=True)
    return ScalarSeries(found.name, found.options.topic, stamp_ns, value[finite][first])

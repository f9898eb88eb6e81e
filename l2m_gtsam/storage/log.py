"""Messages of logs of any kind, and logs that are tables in memory."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat

from l2m_gtsam.data import IntArray
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag_options import Stamps
from l2m_gtsam.storage.messages import stamp_of
from l2m_gtsam.storage.units import Unit

BAGS = (".bag", ".mcap", ".db3")
TABLES = (".csv", ".ulg")
"""How the names of logs end that are no bags: they have no point clouds and cannot be copied."""
DRIVES = (*BAGS, ".ulg")
"""Files that count as drives in a folder: a table in CSV may be anything there."""
ACCEPTED = "a ROS1 .bag, a ROS2 folder with metadata.yaml, a .db3, .mcap, .csv or .ulg file"


@dataclass(frozen=True)
class Message:
    """A decoded message, its connection and when it was recorded (nanoseconds)."""

    connection: Connection
    record_ns: int
    content: Any

    def stamp_ns(self, stamps: Stamps) -> int:
        """Return the time that counts in nanoseconds."""
        return self.record_ns if stamps is Stamps.RECORD else stamp_of(self.content, self.record_ns)


@dataclass(frozen=True)
class TableExt:
    """What a table states of a topic beside its type."""

    unit: Unit | None = None


@dataclass(frozen=True)
class TableTopic:
    """A topic of a log that is a table.

    Attributes
    ----------
    topic, msgtype
        Name and type.
    stamp_ns
        Times of its rows in nanoseconds, shape (N,).
    contents
        Makes its messages, one for each row.
    unit
        That the table states, if it is a magnetometer's and the table does.
    """

    topic: str
    msgtype: str
    stamp_ns: IntArray
    contents: Callable[[], Iterator[Any]]
    unit: Unit | None = None


class TableLog:
    """A log whose topics are tables in memory: what readers need of a ``Bag``."""

    def __init__(self, path: Path, channels: Sequence[TableTopic]) -> None:
        self.path = path
        self._channels = tuple(channels)
        text = MessageDefinition(MessageDefinitionFormat.NONE, "")
        self.connections = tuple(
            Connection(index, c.topic, c.msgtype, text, "", len(c.stamp_ns), TableExt(c.unit), None)  # type: ignore[arg-type]
            for index, c in enumerate(self._channels)
        )

    @property
    def duration_s(self) -> float:
        """Time between the first and the last row in seconds."""
        filled = [c.stamp_ns for c in self._channels if len(c.stamp_ns)]
        if not filled:
            return 0.0
        first, last = min(s.min() for s in filled), max(s.max() for s in filled)
        return float(last - first) * 1e-9

    def messages(
        self, connections: Sequence[Connection], progress: Count | None = None
    ) -> Iterator[Message]:
        """Yield the messages of topics, one topic after the other."""
        total, done = sum(c.msgcount for c in connections), 0
        for connection in connections:
            channel = self._channels[connection.id]
            rows = zip(channel.stamp_ns.tolist(), channel.contents(), strict=True)
            for stamp_ns, content in rows:
                yield Message(connection, stamp_ns, content)
            done += connection.msgcount
            if progress is not None:
                progress(done, total)

"""Open a bag of any kind, and turn whatever is wrong with it into one line."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from l2m_gtsam.errors import BagError

ACCEPTED = "a ROS1 .bag, a ROS2 folder with metadata.yaml, a .db3 or an .mcap file"


@dataclass(frozen=True)
class Message:
    """A decoded message, its connection and when it was recorded (nanoseconds)."""

    connection: Connection
    record_ns: int
    content: Any


class Bag:
    """An open bag: what it holds, and its messages one by one."""

    def __init__(self, path: Path, reader: AnyReader) -> None:
        self.path = path
        self._reader = reader
        self._default = get_typestore(Stores.ROS1_NOETIC if not reader.is2 else Stores.ROS2_JAZZY)

    @property
    def connections(self) -> Sequence[Connection]:
        """Every connection of the bag."""
        return self._reader.connections

    @property
    def duration_s(self) -> float:
        """Time between the first and the last record in seconds."""
        return self._reader.duration * 1e-9

    def messages(self, connections: Sequence[Connection]) -> Iterator[Message]:
        """Yield the messages of these connections in order of record time.

        Raises
        ------
        BagError
            The bag is damaged.
        """
        if not connections:
            return
        stream = self._reader.messages(connections=connections)
        while True:
            try:
                connection, record_ns, raw = next(stream)
                content = self._decode(raw, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:
                raise BagError(_damaged(self.path, error)) from error
            yield Message(connection, record_ns, content)

    def _decode(self, raw: bytes, msgtype: str) -> Any:
        # A bag may define some of its types and not others.
        if msgtype in self._reader.typestore.fielddefs:
            return self._reader.deserialize(raw, msgtype)
        if self._reader.is2:
            return self._default.deserialize_cdr(raw, msgtype)
        return self._default.deserialize_ros1(raw, msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for reading.

    Raises
    ------
    BagError
        No such file, not a bag, damaged, or without messages.
    """
    if not path.exists():
        raise BagError(f"{path}: no such file; accepted: {ACCEPTED}")
    try:
        # Only used by rosbags when no type at all is defined in the bag.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except Exception as error:
        raise BagError(_damaged(path, error)) from error
    try:
        if not reader.message_count:
            raise BagError(f"{path}: the bag has no messages")
        yield Bag(path, reader)
    finally:
        reader.close()


def _damaged(path: Path, error: Exception) -> str:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return f"{path}: not a readable bag ({reason}); it may be truncated; accepted: {ACCEPTED}"

"""Open a bag of any kind, and turn whatever is wrong with it into one line.

rosbags is used below its ``AnyReader``, which parses the definitions of every topic, refuses the
bag when one of them is odd, and uses default types only when no topic carries a definition. Here
only the types that are read are parsed, each from the bag's own definition where it has one.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bounded import is_there, require_regular
from l2m_gtsam.storage.drive_lists import ROS2_HEADER, is_bag
from l2m_gtsam.storage.log import ACCEPTED, TABLES, Message
from l2m_gtsam.storage.messages import TF_TYPE, TF_TYPES
from l2m_gtsam.storage.rosbags_bounds import (
    MOST_DEFINITION,
    MOST_SEQUENCE,
    bound_rosbags,
    check_definition,
    check_names,
    check_sizes,
)
from l2m_gtsam.text import shown

bound_rosbags()

# mcap counts nanoseconds unsigned, everything else in 63 bits.
LATEST_NS = (1 << 63) - 1
STORED = (".yaml", ".db3", ".mcap", ".zstd")  # what a folder's bag is read from
PROGRESS_EVERY = 2000


@dataclass(frozen=True)
class RawMessage:
    """A message as it was recorded, its connection and when (nanoseconds)."""

    connection: Connection
    record_ns: int
    data: bytes


@dataclass(frozen=True)
class Codec:
    """How the messages of one type are decoded and encoded.

    Attributes
    ----------
    path
        The bag, for messages to its user.
    msgtype
        The type.
    store
        Its definition, and those of what it consists of.
    is_ros1
        Whether ROS1 encodes them.
    """

    path: Path
    msgtype: str
    store: Typestore
    is_ros1: bool

    def decode(self, data: bytes) -> Any:
        """Return a message; a BagError if it is damaged."""
        decode = self.store.deserialize_ros1 if self.is_ros1 else self.store.deserialize_cdr
        try:
            return decode(data, self.msgtype)
        except Exception as error:
            raise BagError(_damaged(self.path, error)) from error

    def encode(self, message: Any) -> bytes:
        """Return a message as it is recorded."""
        encode = self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr
        return bytes(encode(message, self.msgtype))


class Bag:
    """An open bag: what it holds, and its messages one by one."""

    def __init__(self, path: Path, reader: Ros1Reader | Ros2Reader) -> None:
        self.path = path
        self.reader = reader
        self.connections: Sequence[Connection] = reader.connections

    @property
    def duration_s(self) -> float:
        """Time between the first and the last record in seconds."""
        return self.reader.duration * 1e-9

    def messages(
        self, connections: Sequence[Connection], progress: Count | None = None
    ) -> Iterator[Message]:
        """Yield the messages of these connections in order of record time.

        Parameters
        ----------
        connections
            Connections of this bag.
        progress
            Called now and then with the messages read and their number.

        Raises
        ------
        BagError
            The bag is damaged, or holds fewer messages than its index promises.
        """
        codecs = {c.id: self.codec(c) for c in connections}
        for raw in self.raw_messages(connections, progress):
            yield Message(raw.connection, raw.record_ns, codecs[raw.connection.id].decode(raw.data))

    def raw_messages(
        self, connections: Sequence[Connection], progress: Count | None = None
    ) -> Iterator[RawMessage]:
        """Yield the messages of these connections as ``messages`` does, but not decoded."""
        if not connections:
            return
        stream, received = self.reader.messages(list(connections)), 0
        promised = sum(c.msgcount for c in connections)
        while True:
            if progress is not None and received % PROGRESS_EVERY == 0:
                progress(received, promised)
            try:
                connection, record_ns, raw = next(stream)
            except StopIteration:
                break
            except Exception as error:
                raise BagError(_damaged(self.path, error)) from error
            # SQLite keeps in a column whatever is written to it.
            if not isinstance(record_ns, int) or not -LATEST_NS <= record_ns <= LATEST_NS:
                raise BagError(f"{self.path}: damaged: a message is recorded at {record_ns!r} ns")
            if not isinstance(raw, bytes | bytearray | memoryview):
                topic = connection.topic
                raise BagError(f"{self.path}: damaged: a message on {topic} is {raw!r:.20}")
            received += 1
            yield RawMessage(connection, record_ns, raw)
        if progress is not None:
            progress(received, promised)
        if received < promised:
            raise BagError(
                f"{self.path}: truncated: its index promises {promised} messages on the topics "
                f"that are read, {received} are there; record it again or reindex it"
            )

    def codec(self, connection: Connection) -> Codec:
        """Return how messages of a connection are decoded and encoded.

        Raises
        ------
        BagError
            The definition of its type cannot be understood.
        """
        # tf/tfMessage, which ROS1 used before tf2, has the layout of its successor.
        msgtype = TF_TYPE if connection.msgtype in TF_TYPES else connection.msgtype
        is_ros1 = isinstance(self.reader, Ros1Reader)
        try:
            store = typestore(is_ros1, msgtype, connection.msgdef)
        except Exception as error:
            reason = " ".join(str(error).split())[:120]
            raise BagError(
                f"{self.path}: the definition of {msgtype} on {connection.topic} cannot be "
                f"understood ({reason})"
            ) from error
        return Codec(self.path, msgtype, store, is_ros1)


class _AnyCaseReader(Ros2Reader):
    """A reader of ROS2 bags to whom ``.MCAP`` is ``.mcap``."""

    def __init__(self, path: Path) -> None:
        known = Ros2Reader.STORAGE_PLUGINS
        kind = "dir" if path.is_dir() else path.suffix.lower()
        self.STORAGE_PLUGINS = {**known, path.suffix: known[kind]}
        super().__init__(path)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for reading.

    Raises
    ------
    BagError
        No such file, not a bag, damaged, or without messages.
    """
    _check_files(path)
    try:
        is_ros1 = path.suffix.lower() == ".bag"
        reader = Ros1Reader(path) if is_ros1 else _AnyCaseReader(path)
        reader.open()
    except Exception as error:
        raise BagError(_damaged(path, error)) from error
    try:
        _check_content(path, reader)
        if not reader.message_count:
            raise BagError(f"{path}: the bag has no messages")
        yield Bag(path, reader)
    finally:
        reader.close()


def _check_files(path: Path) -> None:
    """Refuse what is no bag, and what would be waited for: pipes and devices."""
    if not is_there(path, BagError):
        raise BagError(f"{path}: no such file; accepted: {ACCEPTED}")
    if not path.is_dir():
        require_regular(path, BagError)
        if path.suffix.lower() in TABLES:
            raise BagError(
                f"{path}: a bag is needed here, this is a table; for readings in one, `l2m export "
                "--format json` has C and H"
            )
        if not is_bag(path):
            raise BagError(f"{path}: not a bag, by its name; accepted: {ACCEPTED}")
        return
    try:
        inside = [each for each in path.iterdir() if not each.is_dir()]
    except OSError as error:
        raise BagError(f"{path}: cannot be read: {error.strerror or error}") from error
    for file in inside:
        if file.suffix.lower() in STORED:
            require_regular(file, BagError)
    if not is_bag(path):
        logs = sorted(each.name for each in path.iterdir() if _may_be_log(each))
        there = f"a log in it is {shown(logs[0])}" if logs else "there is no log in it"
        raise BagError(f"{path}: a folder without {ROS2_HEADER}; {there}; accepted: {ACCEPTED}")


def _may_be_log(path: Path) -> bool:
    try:
        return is_bag(path) or path.suffix.lower() in TABLES
    except BagError:  # a folder that cannot be read
        return False


def _check_content(path: Path, reader: Ros1Reader | Ros2Reader) -> None:
    """Refuse an open bag that declares what cannot be held in memory."""
    try:
        check_sizes(reader)
        check_names(reader)
    except Exception as error:
        raise BagError(_damaged(path, error)) from error


def _damaged(path: Path, error: Exception) -> str:
    reason = shown(" ".join(str(error).split())[:200]) or type(error).__name__
    return f"{path}: not a readable bag ({reason}); it may be truncated; accepted: {ACCEPTED}"


@cache
def _default_typestore(is_ros1: bool) -> Typestore:
    """Return ROS's own types; those read here have one layout in all distributions."""
    if not is_ros1:
        return get_typestore(Stores.ROS2_JAZZY)
    store = get_typestore(Stores.ROS1_NOETIC)
    # rosbags ships Noetic's common messages without tf2_msgs.
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF_TYPE))
    return store


@lru_cache(maxsize=64)  # a bag's sensors are of few types
def typestore(is_ros1: bool, msgtype: str, definition: MessageDefinition) -> Typestore:
    """Return the bag's own definition of a type, or ROS's where it has none as text."""
    if definition.format is not MessageDefinitionFormat.MSG or not definition.data.strip():
        store = _default_typestore(is_ros1)
        if msgtype not in store.types:
            raise ValueError("the bag holds none, and ROS has none; an mcap file would carry it")
        return store
    if len(definition.data) > MOST_DEFINITION:
        raise ValueError(f"it has {len(definition.data):,} letters")
    types = get_types_from_msg(definition.data, msgtype)
    check_definition(types)
    store = get_typestore(Stores.EMPTY)
    store.max_sequence_length = MOST_SEQUENCE
    store.register(types)
    store.get_msgdef(msgtype)
    return store

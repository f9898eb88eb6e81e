"""A new bag of the same kind as another, which appears when it is complete or not at all."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag1,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.rosbag2.storage_mcap import McapReader

from l2m_gtsam.errors import OutputError
from l2m_gtsam.storage.open_bag import Bag, typestore
from l2m_gtsam.storage.parts import part_folder
from l2m_gtsam.storage.ros_messages import ros1, ros2
from l2m_gtsam.storage.rosbags_bounds import storages

SUFFIX = {StoragePlugin.MCAP: ".mcap", StoragePlugin.SQLITE3: ".db3"}
TEXT = "std_msgs/msg/String"
FOREVER = QosTime(2147483647, 4294967295)
# Transient local: who subscribes late gets the last message.
KEPT = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    FOREVER,
    FOREVER,
    QosLiveliness.AUTOMATIC,
    FOREVER,
    False,
)
# ROS 2's own word for a type without a hash: version 1, all zero.
NO_HASH = "RIHS01_" + 64 * "0"


@dataclass
class BagCopy:
    """A bag that is being written; what it takes over keeps its type, quality of service and time.

    Attributes
    ----------
    source
        The bag that is copied.
    writer
        What writes the new one.
    """

    source: Bag
    writer: Any
    _known: list[tuple[tuple[Any, ...], Connection]] = field(default_factory=list)

    def add(self, connection: Connection, topic: str | None = None) -> Connection:
        """Return a connection of the new bag that is like one of the source.

        Parameters
        ----------
        connection
            Connection of the source.
        topic
            Its name in the new bag, if it is another.
        """
        key = (topic or connection.topic, connection.msgtype, connection.digest, connection.ext)
        for known, there in self._known:  # a list: the extension of a connection has no hash
            if known == key:
                return there
        added = self._add(connection, key[0])
        self._known.append((key, added))
        return added

    def write(self, connection: Connection, record_ns: int, data: bytes) -> None:
        """Append a message to a connection of the new bag."""
        self.writer.write(connection, record_ns, data)

    def add_text(self, topic: str) -> tuple[Connection, Callable[[str], bytes]]:
        """Return a new connection of texts that late subscribers get, too, and what encodes one."""
        is_ros1 = isinstance(self.source.reader, Ros1Reader)
        dialect = ros1() if is_ros1 else ros2()
        kept: dict[str, Any] = {"latching": 1} if is_ros1 else {"offered_qos_profiles": [KEPT]}
        connection: Connection = self.writer.add_connection(
            topic, TEXT, typestore=dialect.store, **kept
        )

        def encode(text: str) -> bytes:
            return bytes(dialect.serialize(dialect.make(TEXT, data=text), TEXT))

        return connection, encode

    def _add(self, connection: Connection, topic: str) -> Connection:
        own: dict[str, Any]
        if isinstance(connection.ext, ConnectionExtRosbag1):
            own = {
                "msgdef": connection.msgdef.data,
                "md5sum": connection.digest,
                "callerid": connection.ext.callerid,
                "latching": connection.ext.latching,
            }
        else:
            definition, digest = _described(connection)
            own = {
                "msgdef": definition,
                "rihs01": digest,
                "serialization_format": connection.ext.serialization_format,
                "offered_qos_profiles": connection.ext.offered_qos_profiles,
            }
        added: Connection = self.writer.add_connection(topic, connection.msgtype, **own)
        return added


@contextmanager
def bag_copy(source: Bag, out: Path) -> Iterator[BagCopy]:
    """Write a bag of the same kind, compressed as the source is.

    Parameters
    ----------
    source
        An open bag.
    out
        File (ROS1, ending in ``.bag``) or folder (ROS2), or a single ``.mcap`` or ``.db3`` file,
        which must not exist.

    Raises
    ------
    OutputError
        There is something already, the name is not one for this kind, or it cannot be written.
    """
    check_copy(source, out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        # rosbag2 repeats the folder's name inside, so the name is right and its parent temporary.
        with part_folder(out) as parent:
            single = _is_single(out)
            unfinished = parent / (out.stem if single else out.name)
            with _writer(source.reader, unfinished) as writer:
                yield BagCopy(source, writer)
            finished = unfinished / (unfinished.name + out.suffix) if single else unfinished
            finished.rename(out)
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"{out}: cannot be written: {reason}") from error


def check_copy(source: Bag, out: Path) -> None:
    """Raise an OutputError, before any work is done, if a copy cannot be written there."""
    if out.exists():
        raise OutputError(f"{out}: exists already; choose another --out")
    reader = source.reader
    if isinstance(reader, Ros1Reader):
        if out.suffix != ".bag":
            raise OutputError(f"{out}: the name of a ROS1 bag must end in .bag")
        return
    if out.suffix == ".bag":
        raise OutputError(f"{out}: the name of a ROS2 bag must not end in .bag")
    if _is_single(out) and out.suffix != SUFFIX[_plugin(reader)]:
        raise OutputError(
            f"{out}: the copy is of the same kind; its name must end in "
            f"{SUFFIX[_plugin(reader)]} or be that of a folder"
        )


def _is_single(out: Path) -> bool:
    return out.suffix in SUFFIX.values()


def _writer(reader: Ros1Reader | Ros2Reader, path: Path) -> Ros1Writer | Ros2Writer:
    """Return a writer of the same kind, with the compression and the notes of the source."""
    if isinstance(reader, Ros1Reader):
        ros1 = Ros1Writer(path)
        if (compression := _ros1_compression(reader)) is not None:
            ros1.set_compression(compression)
        return ros1
    ros2 = Ros2Writer(path, version=8, storage_plugin=_plugin(reader))  # 8: humble and later
    ros2.set_compression(_ros2_compression(reader), CompressionFormat.ZSTD)
    for key, value in (reader.storage.metadata.custom or {}).items():
        ros2.set_custom_data(key, value)
    return ros2


def _ros1_compression(reader: Ros1Reader) -> "Ros1Writer.CompressionFormat | None":
    used = {chunk.decompressor for chunk in reader.chunks.values()}
    for compression in Ros1Writer.CompressionFormat:
        if decompressors[compression.name.lower()] in used:
            return compression
    return None


def _ros2_compression(reader: Ros2Reader) -> CompressionMode:
    mode = reader.compression_mode
    if mode:
        return CompressionMode[mode.upper()]
    files = [each for each in storages(reader) if isinstance(each, McapReader)]
    chunks = [chunk for each in files for chunk in each.chunks]
    return CompressionMode.STORAGE if any(c.compression for c in chunks) else CompressionMode.NONE


def _plugin(reader: Ros2Reader) -> StoragePlugin:
    is_mcap = isinstance(storages(reader)[0], McapReader)
    return StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3


def _described(connection: Connection) -> tuple[str, str]:
    """Return the definition and hash of a ROS2 type, also where the source lacks them."""
    text = connection.msgdef.data
    if text.strip() and connection.digest:
        return text, connection.digest
    try:
        store = typestore(False, connection.msgtype, connection.msgdef)
        made, _ = store.generate_msgdef(connection.msgtype, ros_version=2)
        digest = connection.digest or store.hash_rihs01(connection.msgtype)
    except Exception:  # a type that nobody describes is copied all the same
        return text, connection.digest or NO_HASH
    return text if text.strip() else made, digest

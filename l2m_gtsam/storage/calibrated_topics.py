"""Corrected readings as topics beside those of the magnetometers."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.data import CorrectedField, FloatArray, IntArray
from l2m_gtsam.errors import BagError, UnitsError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag_copy import BagCopy
from l2m_gtsam.storage.bag_options import BagOptions, Stamps
from l2m_gtsam.storage.field_types import FIELD_TYPE
from l2m_gtsam.storage.messages import FieldBuffer, header_ns
from l2m_gtsam.storage.open_bag import Bag, Codec, RawMessage
from l2m_gtsam.storage.selection import select_fields, sensor_names
from l2m_gtsam.storage.units import Unit, field_fault, microtesla_per

Correct = Callable[[FloatArray, IntArray], CorrectedField]
"""What corrects readings in microtesla, shape (N, 3), of times in nanoseconds, shape (N,)."""
Key = tuple[str, str]
"""Topic and frame of a sensor."""

ENDING = "calibrated"
VERDICT_TOPIC = "/l2m/verdict"
TESLA_PER_MICROTESLA = 1e-6
# Enough to judge a unit by; more are not kept.
MOST_JUDGED = 20_000
# Of messages that are worked on at once: many readings, but few images.
BLOCK_MESSAGES = 2000
BLOCK_BYTES = 32_000_000


@dataclass(frozen=True)
class SensorTopic:
    """A magnetometer of a bag.

    Attributes
    ----------
    sensor
        Its name.
    topic
        Of the corrected readings.
    sample
        Its first readings as they are written, shape (N, 3).
    """

    sensor: str
    topic: str
    sample: FloatArray


def sensor_topics(bag: Bag, options: BagOptions, progress: Count | None) -> dict[Key, SensorTopic]:
    """Return the magnetometers of a bag by topic and frame.

    Raises
    ------
    BagError
        No such topic, or one of several sensors that cannot be distinguished.
    """
    buffers: dict[Key, FieldBuffer] = {}
    connections = [source.connection for source in select_fields(bag, options)]
    if other := [c for c in connections if c.msgtype != FIELD_TYPE]:
        raise BagError(
            f"{bag.path}: topic {other[0].topic} is of type {other[0].msgtype}; corrected readings "
            f"are written beside {FIELD_TYPE} only; `l2m export --format json` has C and H"
        )
    for message in bag.messages(connections, progress):
        key = (message.connection.topic, message.content.header.frame_id)
        buffer = buffers.setdefault(key, FieldBuffer(*key))
        if len(buffer.stamp_ns) < MOST_JUDGED:
            vector = message.content.magnetic_field
            buffer.add(message.record_ns, (vector.x, vector.y, vector.z))
    names = sensor_names(bag.path, buffers, options)
    sensors = Counter(topic for topic, _ in buffers)
    return {
        key: SensorTopic(names[key], _topic(key, sensors[key[0]]), buffer.field())
        for key, buffer in buffers.items()
    }


def check_units(bag: Bag, key: Key, found: SensorTopic, options: BagOptions) -> None:
    """Raise a UnitsError if a sensor's readings are not in the unit that they are said to be in."""
    if wrong := field_fault(found.sample, options.units, Unit.TESLA):
        raise UnitsError(f"{bag.path}: topic {key[0]}: {wrong}")


@dataclass
class Calibrator:
    """Copies a bag and puts corrected readings beside those of its magnetometers.

    Attributes
    ----------
    bag
        The source.
    topics
        What is added, by topic and frame of the sensors.
    corrections
        What makes them of readings, by the names of the sensors.
    options
        How readings are read.
    frame
        Of the corrected readings: the lidar's.
    left_out
        Topics that are not copied.
    verdict
        That the calibration was judged by, as text; the first message of the copy.
    """

    bag: Bag
    topics: Mapping[Key, SensorTopic]
    corrections: Mapping[str, Correct]
    options: BagOptions
    frame: str
    left_out: frozenset[str]
    verdict: str
    _codecs: dict[int, Codec] = field(default_factory=dict)

    def copy(self, into: BagCopy, progress: Count | None) -> None:
        """Write all messages of the source and, right after each reading, its correction.

        Raises
        ------
        BagError
            The source is damaged.
        """
        corrected = {topic for topic, _ in self.topics}
        sources = [
            c for c in self.bag.connections if c.msgtype == FIELD_TYPE and c.topic in corrected
        ]
        self._codecs = {c.id: self.bag.codec(c) for c in sources}
        kept = {c.id: into.add(c) for c in self.bag.connections if c.topic not in self.left_out}
        added = self._connections(into, sources)
        stated, encode = into.add_text(free_topic(self.bag, VERDICT_TOPIC))
        blocks = _blocks(self.bag.raw_messages(self.bag.connections, progress))
        for number, block in enumerate(blocks):
            if number == 0:
                into.write(stated, block[0].record_ns, encode(self.verdict))
            extra = self._corrections(block)
            for row, message in enumerate(block):
                if message.connection.id in kept:
                    into.write(kept[message.connection.id], message.record_ns, message.data)
                if row in extra:
                    topic, data = extra[row]
                    into.write(added[message.connection.id, topic], message.record_ns, data)

    def _connections(
        self, into: BagCopy, sources: Sequence[Connection]
    ) -> dict[tuple[int, str], Connection]:
        """Return the new connections by that of the readings and their topic."""
        return {
            (c.id, new.topic): into.add(c, new.topic)
            for c in sources
            for (topic, _), new in self.topics.items()
            if topic == c.topic
        }

    def _corrections(self, block: Sequence[RawMessage]) -> dict[int, tuple[str, bytes]]:
        """Return the corrected readings of a block: topics and messages by row."""
        rows: dict[Key, list[int]] = defaultdict(list)
        contents: dict[int, Any] = {}
        for row, message in enumerate(block):
            if (codec := self._codecs.get(message.connection.id)) is not None:
                contents[row] = codec.decode(message.data)
                key = (message.connection.topic, contents[row].header.frame_id)
                rows[key].append(row)
        found: dict[int, tuple[str, bytes]] = {}
        unit = microtesla_per(self.options.units, Unit.TESLA)
        for key, new in self.topics.items():
            stamps = [self._stamp(block[row], contents[row]) for row in rows[key]]
            field_ut = unit * _readings([contents[row] for row in rows[key]])
            field_ut = self.options.in_order(new.sensor, field_ut)
            result = self.corrections[new.sensor](field_ut, np.array(stamps, dtype=np.int64))
            for row, b, spread in zip(rows[key], result.field, result.covariance, strict=True):
                message = self._message(contents[row], b, spread)
                codec = self._codecs[block[row].connection.id]
                found[row] = (new.topic, codec.encode(message))
        return found

    def _stamp(self, message: RawMessage, content: Any) -> int:
        header = self.options.stamps is Stamps.HEADER
        return header_ns(content) if header else message.record_ns

    def _message(self, content: Any, b: FloatArray, covariance: FloatArray) -> Any:
        """Return a reading of the lidar's axes in tesla; a covariance of zero is an unknown one."""
        x, y, z = (b * TESLA_PER_MICROTESLA).tolist()
        spread = np.nan_to_num(covariance.ravel(), nan=0.0) * TESLA_PER_MICROTESLA**2
        return replace(
            content,
            header=replace(content.header, frame_id=self.frame),
            magnetic_field=replace(content.magnetic_field, x=x, y=y, z=z),
            magnetic_field_covariance=spread,
        )


def free_topic(bag: Bag, name: str) -> str:
    """Return a name that no topic of a bag has: it, or with a number behind it."""
    taken = {connection.topic for connection in bag.connections}
    names = (name if k == 1 else f"{name}_{k}" for k in count(1))
    return next(each for each in names if each not in taken)


def _topic(key: Key, sensors: int) -> str:
    """Return the name of the corrected readings; of several sensors, each has its frame in it."""
    topic, frame = key
    suffix = [frame.strip("/")] if sensors > 1 else []
    return "/".join([topic, *filter(None, suffix), ENDING])


def _readings(contents: Sequence[Any]) -> FloatArray:
    """Return readings as they were written, shape (N, 3)."""
    vectors = [content.magnetic_field for content in contents]
    return np.array([(v.x, v.y, v.z) for v in vectors], dtype=np.float64).reshape(-1, 3)


def _blocks(messages: Iterator[RawMessage]) -> Iterator[list[RawMessage]]:
    """Yield messages in blocks that are worth a batch and fit into memory."""
    block: list[RawMessage] = []
    size = 0
    for message in messages:
        block.append(message)
        size += len(message.data)
        if len(block) >= BLOCK_MESSAGES or size >= BLOCK_BYTES:
            yield block
            block, size = [], 0
    if block:
        yield block

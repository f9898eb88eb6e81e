"""Copies of bags: their begin, or all but a topic."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Reader, Writer


def begin(bag: Path, out: Path, seconds: float, besides: str = "") -> Path:
    """Copy the first seconds of a ROS1 bag."""
    with Reader(bag) as reader, Writer(out) as writer:
        kept = [c for c in reader.connections if c.topic != besides]
        new = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
            for c in kept
        }
        for connection, stamp, raw in reader.messages(kept):
            if stamp - reader.start_time > 1e9 * seconds:
                break
            writer.write(new[connection.id], stamp, raw)
    return out


def without(topic: str, bag: Path, out: Path, seconds: float = np.inf) -> Path:
    """Copy a ROS1 bag, or the begin of it, without one of its topics."""
    with Reader(bag) as reader:
        assert topic in reader.topics
    return begin(bag, out, seconds, besides=topic)

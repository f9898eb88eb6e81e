"""Poses from a topic with paths, as LIO-SAM and others publish where they have been."""

from collections.abc import Iterator, Sequence
from typing import Any

from rosbags.interfaces import Connection

from l2m_gtsam.data import Trajectory
from l2m_gtsam.errors import BagError
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.messages import PoseBuffer, frame_of, header_ns
from l2m_gtsam.storage.open_bag import Bag


def path_trajectory(bag: Bag, paths: Sequence[Connection], progress: Count | None) -> Trajectory:
    """Return the poses of all paths on a topic; of those with one stamp the latest message's.

    A path that grows repeats all poses in each message, as corrected by loop closures: the last
    message then has all of them. Of one that slides along, each message has some.

    Parameters
    ----------
    bag
        The log.
    paths
        Connections with `nav_msgs/Path`.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        There is no path, it is a plan, or its poses are not usable.
    """
    latest: dict[int, Any] = {}
    frames: set[str] = set()
    for content in _grown(bag, paths, progress) or _contents(bag, paths, progress):
        frames.add(frame_of(content))
        stamps = [header_ns(each) for each in content.poses]
        if len(set(stamps)) < min(len(stamps), 2):
            raise BagError(
                f"{bag.path}: the poses of a path on {paths[0].topic} have one stamp: it says "
                "where a vehicle shall go, not where it was; choose another topic with `bag.poses`"
            )
        latest.update(zip(stamps, content.poses, strict=True))
    if len(frames) > 1:
        raise BagError(f"{bag.path}: paths in several frames: {', '.join(sorted(frames)[:10])}")
    if not latest or not frames:
        raise BagError(f"{bag.path}: the topic of the poses has no poses")
    buffer = PoseBuffer(frames.pop(), "lidar")
    for stamp_ns, stamped in sorted(latest.items()):
        buffer.add(stamp_ns, stamped.pose.position, stamped.pose.orientation)
    return buffer.trajectory()


def _contents(bag: Bag, paths: Sequence[Connection], progress: Count | None) -> Iterator[Any]:
    return (message.content for message in bag.messages(paths, progress))


def _grown(bag: Bag, paths: Sequence[Connection], progress: Count | None) -> list[Any]:
    """Return the last path alone if it has all that the first has; decoding all takes N^2 poses."""
    codecs = {c.id: bag.codec(c) for c in paths}
    first, last = None, None
    for raw in bag.raw_messages(paths, progress):
        first, last = first or raw, raw
    if first is None or last is None:
        return []
    begun = codecs[first.connection.id].decode(first.data)
    ended = codecs[last.connection.id].decode(last.data)
    if not begun.poses or len(ended.poses) < len(begun.poses):
        return []
    return [ended] if header_ns(ended.poses[0]) <= header_ns(begun.poses[0]) else []

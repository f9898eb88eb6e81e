"""Read a drive out of a bag: the lidar's poses and every magnetometer's readings."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection

from l2m_gtsam.data import FieldSeries, Recording, Trajectory
from l2m_gtsam.errors import BagError, UnitsError
from l2m_gtsam.geometry import moved
from l2m_gtsam.progress import Count
from l2m_gtsam.recording.pose_order import order_notes
from l2m_gtsam.storage.bag_options import BagOptions, Stamps, TfChain
from l2m_gtsam.storage.clocks import check_clocks, check_stamps, clock_notes
from l2m_gtsam.storage.field_types import FieldSource, by_connection, is_field
from l2m_gtsam.storage.files import source_file
from l2m_gtsam.storage.log import Message
from l2m_gtsam.storage.messages import (
    ALL_POSE_TYPES,
    PATH_TYPE,
    TF_TYPES,
    FieldBuffer,
    PoseBuffer,
    StampBuffer,
    bodies_fault,
    ends_of,
    frame_of,
    header_ns,
    stamp_of,
    stamped_poses,
)
from l2m_gtsam.storage.open_bag import Bag
from l2m_gtsam.storage.open_log import Log, open_log
from l2m_gtsam.storage.pose_files import read_poses
from l2m_gtsam.storage.selection import (
    fields_of_pattern,
    pose_notes,
    select_fields,
    select_poses,
    sensor_names,
)
from l2m_gtsam.storage.tf import Link, chain_frames, compose
from l2m_gtsam.storage.units import field_fault, microtesla_per


@dataclass
class Buffers:
    """Everything that one pass over a bag collects.

    Fields by topic and frame, poses of a topic or of tf by frame and child frame; both times of
    messages by topic of a field, and by ends of poses.
    """

    fields: dict[tuple[str, str], FieldBuffer] = field(default_factory=dict)
    poses: dict[tuple[str, str], PoseBuffer] = field(default_factory=dict)
    field_times: dict[str, StampBuffer] = field(default_factory=dict)
    pose_times: dict[tuple[str, str], StampBuffer] = field(default_factory=dict)


def read_recording(path: Path, options: BagOptions, progress: Count | None = None) -> Recording:
    """Read poses and readings in one pass; other topics are not decoded.

    Parameters
    ----------
    path
        Bag of any kind.
    options
        What to read.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        The bag, a topic or the stamps are not usable; the line says what there is instead.
    UnitsError
        A field's strength does not fit its unit.
    """
    apart = options.pose_file.of(path)
    with open_log(path, options.columns) as bag:
        fields = select_fields(bag, options)
        poses = [] if apart is not None else select_poses(bag, options)
        notes = pose_notes(bag, poses, options)
        buffers = _read(bag, fields, poses, options, progress)
        paths = _path_poses(bag, poses, progress)
    series = _all_series(path, buffers, fields, options)
    trajectory = _trajectory(path, buffers, options, paths)
    check_clocks(path, trajectory, series, apart)
    notes, origins = (*notes, *_clocks(path, buffers, options)), tuple[str, ...]()
    notes += order_notes(apart or path, trajectory)
    source = None if apart is None else source_file(apart)
    if source is not None:
        origins = (f"{path}: poses are those of {source.path} (sha256 {source.sha256})",)
    return Recording(
        trajectory, series, source_file(path), notes=notes, origins=origins, poses=source
    )


def read_fields(path: Path, options: BagOptions) -> tuple[FieldSeries, ...]:
    """Read the magnetometers alone.

    Raises
    ------
    BagError
        The bag has no usable magnetic readings.
    UnitsError
        A field's strength does not fit its unit.
    """
    with open_log(path, options.columns) as bag:
        fields = select_fields(bag, options)
        buffers = _read(bag, fields, [], options, None)
    return _all_series(path, buffers, fields, options)


def has_fields(path: Path, options: BagOptions) -> bool:
    """Return whether a bag has any topic of a magnetometer, by its type or by the options.

    Raises
    ------
    BagError
        The bag cannot be opened.
    """
    with open_log(path, options.columns) as bag:
        named = any(fields_of_pattern(bag, pattern) for pattern in options.fields)
        return named or any(is_field(connection) for connection in bag.connections)


def has_poses(path: Path, options: BagOptions) -> bool:
    """Return whether a bag has poses, or the options say where they are.

    Raises
    ------
    BagError
        The bag cannot be opened.
    """
    named = options.poses is not None or options.tf is not None
    if named or options.pose_file.of(path) is not None:
        return True
    with open_log(path, options.columns) as bag:
        return any(connection.msgtype in ALL_POSE_TYPES for connection in bag.connections)


def read_trajectory(path: Path, options: BagOptions) -> Trajectory:
    """Read poses alone.

    Raises
    ------
    BagError
        The bag has no usable poses.
    """
    if options.pose_file.of(path) is not None:
        return _trajectory(path, Buffers(), options)
    with open_log(path, options.columns) as bag:
        poses = select_poses(bag, options)
        buffers = _read(bag, [], poses, options, None)
        paths = _path_poses(bag, poses, None)
    return _trajectory(path, buffers, options, paths)


def _read(
    bag: Log,
    fields: list[FieldSource],
    poses: list[Connection],
    options: BagOptions,
    progress: Count | None,
) -> Buffers:
    """Make one pass over the bag."""
    buffers, sources = Buffers(), by_connection(fields)
    single = [c for c in poses if c.msgtype != PATH_TYPE and c.id not in sources]
    wanted = {c.id: c for c in (*(f.connection for f in fields), *single)}
    for message in bag.messages(list(wanted.values()), progress):
        if message.connection.id in sources:
            for source in sources[message.connection.id]:
                _add_field(bag.path, buffers, message, source, options)
        else:
            _add_poses(buffers, message, options)
    return buffers


def _path_poses(bag: Log, poses: list[Connection], progress: Count | None) -> Trajectory | None:
    """Return the poses of a topic with paths, if the poses come from one."""
    paths = [c for c in poses if c.msgtype == PATH_TYPE]
    return path_trajectory(bag, paths, progress) if paths and isinstance(bag, Bag) else None


def _add_field(
    path: Path, buffers: Buffers, message: Message, source: FieldSource, options: BagOptions
) -> None:
    content, label, frame = message.content, source.label, frame_of(message.content)
    if (label, frame) not in buffers.fields:
        buffers.fields[label, frame] = FieldBuffer(label, frame, source.unit)
    times = buffers.field_times.setdefault(label, StampBuffer())
    times.add(stamp_of(content, message.record_ns), message.record_ns)
    try:
        reading = source.reading(content)
    except ValueError as error:
        raise BagError(
            f"{path}: {source.connection.msgtype} on {source.connection.topic} {error}"
        ) from error
    buffers.fields[label, frame].add(message.stamp_ns(options.stamps), reading)


def _add_poses(buffers: Buffers, message: Message, options: BagOptions) -> None:
    msgtype, record_ns = message.connection.msgtype, message.record_ns
    is_tf = msgtype in TF_TYPES
    for stamped, pose in stamped_poses(message.content, msgtype):
        ends = ends_of(stamped, pose, msgtype)
        if ends not in buffers.poses:
            static = is_tf and "tf_static" in message.connection.topic
            buffers.poses[ends] = PoseBuffer(*ends, static=static)
        taken = stamp_of(stamped, record_ns)
        buffers.pose_times.setdefault(ends, StampBuffer()).add(taken, record_ns)
        stamp = record_ns if options.stamps is Stamps.RECORD else taken
        buffers.poses[ends].add(stamp, pose.position, pose.orientation, pose.covariance)


def _clocks(path: Path, buffers: Buffers, options: BagOptions) -> tuple[str, ...]:
    """Return what is worth a warning of the clocks behind header stamps, where these count."""
    if options.stamps is Stamps.RECORD:
        return ()
    ends = list(buffers.poses)
    if options.tf is not None:
        chain = chain_frames(ends, options.tf.ends)
        ends = [key for key in ends if key[1] in chain and not buffers.poses[key].static]
    return clock_notes(path, [buffers.pose_times[each] for each in ends], buffers.field_times)


def _trajectory(
    path: Path, buffers: Buffers, options: BagOptions, paths: Trajectory | None = None
) -> Trajectory:
    """Return the poses of the lidar: from a file, from paths, from tf or from single poses."""
    apart = options.pose_file.of(path)
    try:
        if apart is not None:
            tracked = read_poses(apart, options.pose_file)
        elif paths is not None:
            tracked = paths
        else:
            tracked = _composed(path, buffers, options.tf) if options.tf else _single(path, buffers)
    except ValueError as error:
        raise BagError(f"{path}: poses: {error}") from error
    check_stamps(path, "poses", tracked.stamp_ns)
    fixed, covariance = options.tracked_to_lidar.rigid(), tracked.covariance
    return replace(
        tracked,
        R=tracked.R @ fixed.R,
        p=tracked.R @ fixed.t + tracked.p,
        frame=options.frame or tracked.frame,
        covariance=None if covariance is None else moved(covariance, fixed),
    )


def _single(path: Path, buffers: Buffers) -> Trajectory:
    """Return the poses of the one body that a topic tracks."""
    if not buffers.poses:
        raise BagError(f"{path}: the topic of the poses has no messages")
    if wrong := bodies_fault(buffers.poses):
        raise ValueError(wrong)
    (buffer,) = buffers.poses.values()
    return buffer.trajectory()


def _composed(path: Path, buffers: Buffers, chain: TfChain) -> Trajectory:
    """Return the poses of a chain; a fault in a link beside it does not matter."""
    needed = chain_frames(buffers.poses, chain.ends)
    links: dict[str, Link] = {}
    for (parent, child), buffer in buffers.poses.items():
        if child in needed and child in links:
            raise ValueError(
                f"tf gives {child!r} two parents, {links[child].parent!r} and {parent!r}"
            )
        try:
            links[child] = buffer.link()
        except ValueError:
            if child in needed:
                raise
    return compose(links, *chain.ends, chain.max_gap_s, str(path))


def _all_series(
    path: Path, buffers: Buffers, fields: list[FieldSource], options: BagOptions
) -> tuple[FieldSeries, ...]:
    """Return every sensor's readings, in order of name; also of topics without messages."""
    received = {topic for topic, _ in buffers.fields}
    empty = {(s.label, ""): FieldBuffer(s.label, "") for s in fields if s.label not in received}
    found = {**buffers.fields, **empty}
    names = sensor_names(path, found, options)
    series = tuple(
        _series(path, names[key], found[key], options)
        for key in sorted(found, key=lambda key: names[key])
    )
    if not any(np.isfinite(each.field).all(axis=1).any() for each in series):
        topics = ", ".join(each.topic for each in series) or "the chosen topics"
        raise BagError(f"{path}: no finite reading in {topics}")
    return series


def _series(path: Path, name: str, buffer: FieldBuffer, options: BagOptions) -> FieldSeries:
    """Return one sensor's readings in uT, in order of time."""
    order = np.argsort(buffer.stamps(), kind="stable")
    stamps, written = buffer.stamps()[order], buffer.field()[order]
    check_stamps(path, f"topic {buffer.topic}", stamps)
    if wrong := field_fault(written, options.units, buffer.unit):
        raise UnitsError(f"{path}: topic {buffer.topic}: {wrong}")
    values = options.in_order(name, written * microtesla_per(options.units, buffer.unit))
    return FieldSeries(name, buffer.topic, buffer.frame, stamps, values)


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
    every = (message.content for message in bag.messages(paths, progress))
    for content in _grown(bag, paths, progress) or every:
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

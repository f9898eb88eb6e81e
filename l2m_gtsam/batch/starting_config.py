"""A configuration to start from, made of what is in a log."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from ruamel.yaml import YAML

from l2m_gtsam.config import Config
from l2m_gtsam.progress import Count
from l2m_gtsam.storage.bag_options import BagOptions, PoseFileOptions
from l2m_gtsam.storage.inspect import POSE_FILE, BagReport, TopicReport, inspect_bag
from l2m_gtsam.storage.messages import ALL_POSE_TYPES, TF_TYPES
from l2m_gtsam.storage.units import EARTH_UT, Unit
from l2m_gtsam.text import shown

TRACKED = ("base_link", "lidar", "velodyne", "os_sensor", "base_footprint", "imu_link", "body")


def starting_config(path: Path, given: BagOptions, progress: Count | None = None) -> str:
    """Return a configuration for a log in YAML, and in comments why and what else there is.

    Parameters
    ----------
    path
        Log of any kind.
    given
        What is known already: poses in a file.
    progress
        Called with the messages read and their number.

    Raises
    ------
    BagError
        The log cannot be read.
    """
    report = inspect_bag(path, given, progress)
    lines = [f"# For {path}. `l2m config` has all options.", "bag:"]
    lines += [*_fields(report), *_pose_file(given.pose_file, path), *_poses(report)]
    lines += [*_stamps(report)]
    if lines[-1] == "bag:":
        lines[-1] = "bag: {}"
    # Names in comments are those of others: none ends its line.
    lines = [shown(each, None) for each in lines]
    chosen = _read("\n".join(lines))
    again = inspect_bag(path, chosen.bag)
    lines += _starts(again)
    lines += [f"# Cannot be calibrated as it is: {_one_line(each)}" for each in again.obstacles]
    lines += [f"# {_one_line(each)}" for each in again.notes]
    return "\n".join(shown(each, None) for each in lines) + "\n"


def _read(text: str) -> Config:
    content: Any = YAML(typ="safe", pure=True).load(text)
    return Config.model_validate(content)


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _used(report: BagReport, what: str) -> list[TopicReport]:
    return [each for each in report.topics if each.role == what]


def _fields(report: BagReport) -> Iterator[str]:
    """Yield the magnetometers and their unit."""
    fields = _used(report, "field")
    if not fields:
        return
    yield f"  fields: {json.dumps([each.topic for each in fields])}"
    for each in fields:
        yield f"  # {each.topic}: {each.msgtype}, {each.rate_hz:.3g} Hz{_strength(each)}"
    if any(len(each.frames) > 1 for each in fields):
        yield "  split_by_frame: true  # a topic has readings in several frames"
    suggested = [each.likely_units for each in fields if each.likely_units is not None]
    named = {each for each in suggested if isinstance(each, Unit)}
    if len(named) == 1:
        yield f"  units: {named.pop().value}  # likely, by the strength of the readings"
    elif suggested and not named:
        units = median(float(each) for each in suggested)
        yield f"  units: {units:.3g}  # uT per count: makes {EARTH_UT:g} uT; see the data sheet"


def _strength(topic: TopicReport) -> str:
    found = topic.strength
    if found is None or not found.readings:
        return ""
    return f", |B| {found.low:.3g} - {found.median:.3g} - {found.high:.3g} uT"


def _pose_file(given: PoseFileOptions, path: Path) -> Iterator[str]:
    """Yield the file with the poses, if one is known."""
    if (poses := given.of(path)) is not None:
        yield "  pose_file:"
        yield f"    path: {json.dumps(str(poses))}"
        if given.times is not None:
            yield f"    times: {json.dumps(str(given.times))}"


def _poses(report: BagReport) -> Iterator[str]:
    """Yield where poses come from, and what else has some."""
    if any(each.msgtype == POSE_FILE for each in report.topics):
        return
    used = {each.topic for each in _used(report, "poses")}
    named = [each for each in report.topics if each.msgtype in ALL_POSE_TYPES and each.count]
    named.sort(key=lambda each: each.topic not in used)
    for number, each in enumerate(named):
        other = "# " if number else ""
        yield f"  {other}poses: {json.dumps(each.topic)}  # {_of_poses(each)}"
    moving = [t for t in report.topics if t.msgtype in TF_TYPES and "tf_static" not in t.topic]
    if not named and moving:
        yield from _chain([t for t in report.topics if t.msgtype in TF_TYPES])


def _of_poses(topic: TopicReport) -> str:
    known = ", with covariance" if "with covariance" in topic.use else ""
    return f"{topic.msgtype}, {topic.rate_hz:.3g} Hz{known}"


def _chain(topics: Sequence[TopicReport]) -> Iterator[str]:
    """Yield the most likely chain of transforms: from the root of the tree to the vehicle."""
    links = [link for topic in topics for link in topic.links]
    parents = {child: parent for parent, child in links}
    roots = sorted({parent for parent, _ in links} - set(parents))
    if not roots:
        return
    tracked = next((name for name in TRACKED if name in parents), next(iter(parents)))
    root = tracked
    while root in parents:
        root = parents.pop(root)
    yield f"  tf: {{frame: {json.dumps(root)}, child_frame: {json.dumps(tracked)}}}"
    some = ", ".join(f"{parent} > {child}" for parent, child in links[:20])
    yield f"  # of the transforms {_one_line(some)}"


def _stamps(report: BagReport) -> Iterator[str]:
    if any("`bag.stamps: record`" in each for each in report.obstacles):
        yield "  stamps: record  # header stamps are missing, or of different clocks"


def _starts(report: BagReport) -> Iterator[str]:
    """Yield the sensors by the names that other options know them by."""
    names = [each.topic.lstrip("/") for each in _used(report, "field")]
    if names:
        yield "# calibration:"
        yield "#   start:  # about where the sensors are in the lidar's frame, metres; if known"
        yield from (f"#     {json.dumps(name)}: [0.0, 0.0, 0.0]" for name in names)

"""Sensors as links with fixed joints: a URDF of their own, or put into that of a robot."""

import re
from dataclasses import dataclass, field
from html import escape
from typing import Any
from xml.parsers import expat

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.storage.exports.export import Export, ExportedSensor

COMMENT = "l2m_gtsam:"
OWN_COMMENTS = re.compile(rb"[ \t]*<!-- l2m_gtsam:(?:(?!-->).)*-->[ \t]*\r?\n?")
"""Lines that an earlier export put into a robot's URDF."""


def urdf_text(export: Export) -> str:
    """Return a URDF of the lidar and its sensors alone."""
    comments = "".join(f"  <!-- {comment_text(line)} -->\n" for line in export.origin)
    links = "".join(f"  {link_text(s.frame)}\n" for s in export.sensors)
    joints = "".join(
        f"  {joint_text(joint_name(s, export), s, export.lidar_frame, '  ')}\n"
        for s in export.sensors
    )
    return (
        f'<?xml version="1.0" encoding="utf-8"?>\n<robot name="magnetometers">\n{comments}'
        f"  {link_text(export.lidar_frame)}\n{links}{joints}</robot>\n"
    )


def joint_name(sensor: ExportedSensor, export: Export) -> str:
    """Return the name of the joint between the lidar and a sensor."""
    return f"{export.lidar_frame}_to_{sensor.frame}"


def link_text(frame: str) -> str:
    """Return an empty link."""
    return f'<link name="{escape(frame)}"/>'


def joint_text(name: str, sensor: ExportedSensor, lidar_frame: str, indent: str) -> str:
    """Return the fixed joint of a sensor.

    Its origin is ``T_lidar_mag``: metres, and roll, pitch, yaw about the fixed axes x, y, z.

    Parameters
    ----------
    name
        Of the joint.
    sensor
        The child.
    lidar_frame
        Link of the lidar, the parent.
    indent
        Whitespace before all of its lines but the first.
    """
    transform = sensor.T_lidar_mag
    lines = [
        f'<joint name="{escape(name)}" type="fixed">',
        f'  <parent link="{escape(lidar_frame)}"/>',
        f'  <child link="{escape(sensor.frame)}"/>',
        f'  <origin xyz="{_numbers(transform.t)}" rpy="{_numbers(roll_pitch_yaw(transform.R))}"/>',
        "</joint>",
    ]
    return f"\n{indent}".join(lines)


def roll_pitch_yaw(R: FloatArray) -> FloatArray:
    """Return the angles of ``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)`` in radians, shape (3,).

    Yaw comes first and is taken out of R before the others are read off: that holds to rounding
    at a pitch of 90 degrees, too, where only the difference of roll and yaw is determined.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = c * R[0] + s * R[1], c * R[1] - s * R[0]
    return np.array([np.arctan2(-y[2], y[1]), np.arctan2(-R[2, 0], x[0]), yaw])


def comment_text(line: str) -> str:
    """Return a line as a comment may contain it: without two hyphens."""
    return re.sub("-(?=-)", "- ", line).rstrip("-")


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)


ENCODINGS = (None, "utf-8", "us-ascii", "ascii")
TAG_END = re.compile(rb"""[^"'>]*(?:"[^"]*"[^"'>]*|'[^']*'[^"'>]*)*>""")


@dataclass
class UrdfJoint:
    """A joint between two links, and the bytes it takes."""

    name: str
    start: int
    end: int = 0
    parent: str = ""
    child: str = ""


@dataclass
class UrdfFile:
    """A URDF, and where its links and joints are.

    Attributes
    ----------
    name
        Of the file, for messages.
    data
        Its content.
    links
        Names of its links.
    joints
        Its joints in their order.
    end
        Where the end tag of the robot begins.
    """

    name: str
    data: bytes
    links: list[str] = field(default_factory=list)
    joints: list[UrdfJoint] = field(default_factory=list)
    end: int = -1

    @classmethod
    def parse(cls, name: str, data: bytes) -> "UrdfFile":
        """Read the links and joints of a URDF; entities and document types are refused.

        Raises
        ------
        ConfigError
            It is no XML in UTF-8, no robot, brings definitions of its own, or still is a xacro.
        """
        found = cls(name, data)
        try:
            data.decode("utf-8")
            _Reader(found).read()
        except UnicodeDecodeError as error:
            raise ConfigError(f"{name}: is not text in UTF-8; save it so") from error
        except expat.ExpatError as error:
            raise ConfigError(f"{name}: not valid XML: {error}") from error
        return found

    def joint_of(self, link: str) -> UrdfJoint | None:
        """Return the joint whose child is a link, if there is one."""
        return next((joint for joint in self.joints if joint.child == link), None)

    def ancestors(self, link: str) -> list[str]:
        """Return the links above one, from near to far."""
        above: list[str] = []
        joint = self.joint_of(link)
        while joint is not None and joint.parent not in above:
            above.append(joint.parent)
            joint = self.joint_of(joint.parent)
        return above


class _Reader:
    """Goes once through the elements of a URDF."""

    def __init__(self, found: UrdfFile) -> None:
        self._found, self._depth = found, 0
        self._joint: UrdfJoint | None = None
        self._parser: Any = expat.ParserCreate()
        self._parser.XmlDeclHandler = self._declaration
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._finish

    def read(self) -> None:
        self._parser.Parse(self._found.data, True)

    def _declaration(self, _version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and encoding.lower() not in ENCODINGS:
            raise ConfigError(f"{self._found.name}: its encoding is {encoding}; save it as UTF-8")

    def _doctype(self, *_: object) -> None:
        raise ConfigError(
            f"{self._found.name}: has a document type definition, which a URDF does not need and "
            "which is not read; remove it"
        )

    def _begin(self, tag: str, attributes: dict[str, str]) -> None:
        if self._depth == 0 and tag != "robot":
            raise ConfigError(f"{self._found.name}: not a URDF: its root is <{tag}>, not <robot>")
        if tag.startswith("xacro:"):
            raise ConfigError(f"{self._found.name}: is a xacro file; run `xacro` on it first")
        if self._depth == 1 and tag == "link":
            self._found.links.append(attributes.get("name", ""))
        elif self._depth == 1 and tag == "joint":
            self._joint = UrdfJoint(attributes.get("name", ""), self._parser.CurrentByteIndex)
        elif self._depth == 2 and self._joint is not None and tag in ("parent", "child"):
            setattr(self._joint, tag, attributes.get("link", ""))
        self._depth += 1

    def _finish(self, tag: str) -> None:
        self._depth -= 1
        here = self._parser.CurrentByteIndex
        if self._depth == 0:
            self._found.end = here
        elif self._depth == 1 and self._joint is not None:
            self._joint.end = self._end_of(self._joint.start, here)
            self._found.joints.append(self._joint)
            self._joint = None

    def _end_of(self, start: int, here: int) -> int:
        """Return where an element ends, of which the parser reports where its end tag begins."""
        data = self._found.data
        first = TAG_END.match(data, start)
        if first is not None and data[first.end() - 2 : first.end()] == b"/>":
            return first.end()
        return data.index(b">", here) + 1


def edited_urdf(export: Export, name: str, data: bytes) -> bytes:
    """Return a URDF with the sensors in it.

    The joint above a sensor's link is replaced where there is one and keeps its name; missing links
    and joints, origin and verdict are added before the end. All other bytes stay, comments too, but
    for those of an earlier calibration.

    Parameters
    ----------
    export
        The sensors; the frame of the lidar is a link of the robot.
    name
        Of the file, for messages.
    data
        Its content.

    Raises
    ------
    ConfigError
        The file is no URDF, has no link for the lidar, or hangs the lidar below a sensor.
    """
    urdf = UrdfFile.parse(name, OWN_COMMENTS.sub(b"", data))
    _check(urdf, export)
    added: list[str] = []
    spans: list[tuple[UrdfJoint, bytes]] = []
    for sensor in export.sensors:
        joint = urdf.joint_of(sensor.frame)
        if sensor.frame not in urdf.links:
            added.append(link_text(sensor.frame))
        if joint is None:
            free = _free_name(urdf, joint_name(sensor, export))
            added.append(joint_text(free, sensor, export.lidar_frame, "  "))
        else:
            spans.append((joint, _replacement(urdf, joint, sensor, export.lidar_frame)))
    notes = [f"<!-- {COMMENT} {comment_text(line)} -->" for line in export.origin]
    return _spliced(urdf, spans, [*added, *notes])


def _check(urdf: UrdfFile, export: Export) -> None:
    if export.lidar_frame not in urdf.links:
        there = ", ".join(urdf.links[:10]) or "(none)"
        raise ConfigError(
            f"{urdf.name}: no link {export.lidar_frame!r} for the LiDAR; name it with "
            f"--lidar-frame; there are: {there}"
        )
    children = [joint.child for joint in urdf.joints]
    if twice := next((s for s in export.sensors if children.count(s.frame) > 1), None):
        raise ConfigError(f"{urdf.name}: link {twice.frame!r} hangs below two joints; remove one")
    above = urdf.ancestors(export.lidar_frame)
    if below := next((s for s in export.sensors if s.frame in above), None):
        raise ConfigError(
            f"{urdf.name}: link {export.lidar_frame!r} of the LiDAR hangs below the sensor's link "
            f"{below.frame!r}, which cannot hang below it in turn"
        )


def _replacement(
    urdf: UrdfFile, joint: UrdfJoint, sensor: ExportedSensor, lidar_frame: str
) -> bytes:
    """Return a joint in the place of another, with its name, indented and broken as it was."""
    line = urdf.data.rfind(b"\n", 0, joint.start) + 1
    before = urdf.data[line : joint.start]
    indent = before.decode() if not before.strip() else ""
    text = joint_text(joint.name, sensor, lidar_frame, indent)
    return text.replace("\n", _newline(urdf)).encode()


def _spliced(urdf: UrdfFile, spans: list[tuple[UrdfJoint, bytes]], added: list[str]) -> bytes:
    """Return the file with joints replaced and lines added before its end."""
    newline = _newline(urdf)
    inserted = "".join(f"  {text}\n" for text in added).replace("\n", newline)
    line = urdf.data.rfind(b"\n", 0, urdf.end) + 1
    fresh = not urdf.data[line : urdf.end].strip()  # the end tag has a line of its own
    where = line if fresh and line else urdf.end
    parts, done = [], 0
    for joint, text in sorted(spans, key=lambda span: span[0].start):
        parts += [urdf.data[done : joint.start], text]
        done = joint.end
    middle = inserted if fresh and line else newline + inserted
    return b"".join([*parts, urdf.data[done:where], middle.encode(), urdf.data[where:]])


def _free_name(urdf: UrdfFile, name: str) -> str:
    """Return a name for a joint that no other has."""
    taken = {joint.name for joint in urdf.joints}
    while name in taken:
        name += "_mag"
    return name


def _newline(urdf: UrdfFile) -> str:
    return "\r\n" if b"\r\n" in urdf.data else "\n"

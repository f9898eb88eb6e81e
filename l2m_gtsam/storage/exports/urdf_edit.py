"""Sensors put into the URDF of a robot, everything else of which stays as it stands."""

from l2m_gtsam.errors import ConfigError
from l2m_gtsam.storage.exports.export import Export, ExportedSensor
from l2m_gtsam.storage.exports.urdf import comment_text, joint_name, joint_text, link_text
from l2m_gtsam.storage.exports.urdf_file import Joint, UrdfFile


def edited_urdf(export: Export, name: str, data: bytes) -> bytes:
    """Return a URDF with the sensors in it.

    The joint above a sensor's link is replaced where there is one and keeps its name; missing links
    and joints are added before the end. All other bytes stay, comments too.

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
    urdf = UrdfFile.parse(name, data)
    _check(urdf, export)
    added: list[str] = []
    spans: list[tuple[Joint, bytes]] = []
    for sensor in export.sensors:
        joint = urdf.joint_of(sensor.frame)
        if sensor.frame not in urdf.links:
            added.append(link_text(sensor.frame))
        if joint is None:
            free = _free_name(urdf, joint_name(sensor, export))
            added.append(joint_text(free, sensor, export.lidar_frame, "  "))
        else:
            spans.append((joint, _replacement(urdf, joint, sensor, export.lidar_frame)))
    notes = [f"<!-- {comment_text(line)} -->" for line in export.origin] if added else []
    return _spliced(urdf, spans, [*notes, *added])


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


def _replacement(urdf: UrdfFile, joint: Joint, sensor: ExportedSensor, lidar_frame: str) -> bytes:
    """Return a joint in the place of another, with its name, indented and broken as it was."""
    line = urdf.data.rfind(b"\n", 0, joint.start) + 1
    before = urdf.data[line : joint.start]
    indent = before.decode() if not before.strip() else ""
    text = joint_text(joint.name, sensor, lidar_frame, indent)
    return text.replace("\n", _newline(urdf)).encode()


def _spliced(urdf: UrdfFile, spans: list[tuple[Joint, bytes]], added: list[str]) -> bytes:
    """Return the file with joints replaced and lines added before its end."""
    newline = _newline(urdf)
    inserted = "".join(f"  {text}\n" for text in added).replace("\n", newline)
    line = urdf.data.rfind(b"\n", 0, urdf.end) + 1
    fresh = not urdf.data[line : urdf.end].strip()  # the end tag stands on a line of its own
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

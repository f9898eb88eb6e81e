"""Sensors as links with fixed joints of a URDF."""

import re
from html import escape

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.exports.export import Export, ExportedSensor


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
        What stands before its lines but the first.
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
    """Return a line as it may stand in a comment, which knows no two hyphens."""
    return re.sub("-(?=-)", "- ", line).rstrip("-")


def _numbers(values: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in values)

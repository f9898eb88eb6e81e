"""The formats by name: JSON, Kalibr, a ROS 2 launch file, and those of modules of their own."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scipy.spatial.transform import Rotation

from l2m_gtsam.geometry import as_matrix
from l2m_gtsam.storage.calibration_file import (
    MODEL,
    UNCERTAINTY,
    sensor_entry,
    source_entries,
    verdict_entry,
)
from l2m_gtsam.storage.exports.autopilots import (
    ardupilot_fault,
    ardupilot_text,
    autopilot_notes,
    px4_fault,
    px4_text,
)
from l2m_gtsam.storage.exports.bias_scale import bias_scale_notes, bias_scale_text, not_reducible
from l2m_gtsam.storage.exports.export import Export, ExportedSensor, Fault, not_mounted
from l2m_gtsam.storage.exports.urdf import urdf_text
from l2m_gtsam.storage.yaml_file import yaml_text

UNKNOWN = "null: not determined by the drive and the map (an infinite variance), or not known"


def json_text(export: Export) -> str:
    """Return the sensors with formulas, units, frames, covariances and where they come from.

    Numbers that are not finite, which JSON does not have, are null.
    """
    result = export.result
    content = {
        "format": "l2m-export",
        "version": 1,
        **({"report_id": result.report_id} if result.report_id else {}),
        "model": {"uncertainty": UNCERTAINTY[result.uncertainty], **MODEL, "infinite": UNKNOWN},
        "verdict": verdict_entry(result.judgement),
        "lidar_frame": export.lidar_frame,
        **source_entries(result),
        "versions": result.versions,
        "doubts": list(result.doubts),
        "left_out": dict(export.left_out),
        "sensors": {
            each.calibration.sensor: {"frame": each.frame, **sensor_entry(each.calibration)}
            for each in export.sensors
        },
    }
    return json.dumps(_finite(content), indent=2, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    """Return plain values with None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


CONVENTION = (
    "T_mag_lidar takes points from the lidar frame to the sensor's: p_mag = T_mag_lidar @ p_lidar,",
    "in metres, as Kalibr's T_cam_imu takes them from the imu to the camera.",
    "timeshift_mag_lidar: t_lidar = t_mag + shift in seconds; absent where it is not estimated.",
)


def kalibr_text(export: Export) -> str:
    """Return a chain of sensors ``mag0``, ``mag1`` ... in Kalibr's manner."""
    content = {f"mag{k}": _entry(sensor, export) for k, sensor in enumerate(export.sensors)}
    return yaml_text(content, "\n".join((*export.origin, *CONVENTION)))


def _entry(sensor: ExportedSensor, export: Export) -> dict[str, Any]:
    entry: dict[str, Any] = {"sensor": sensor.calibration.sensor, "frame": sensor.frame}
    entry["T_mag_lidar"] = as_matrix(sensor.T_lidar_mag.inverse()).tolist()
    offset = sensor.calibration.time_offset
    if offset is not None and offset.estimated:
        entry["timeshift_mag_lidar"] = offset.seconds
    if not _split_by_frame(export):
        topic, _, _ = sensor.calibration.sensor.partition(":")  # TOPIC:PATH of `bag.fields`
        entry["rostopic"] = f"/{topic}"
    return entry


def _split_by_frame(export: Export) -> bool:
    """Return whether sensors are named after frames, which says nothing of their topics."""
    bag = export.result.options.get("bag")
    return isinstance(bag, dict) and bool(bag.get("split_by_frame"))


HEAD = '''

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """Publish where every calibrated magnetometer sits in the frame of the LiDAR."""
    return LaunchDescription(
        [
'''
TAIL = """        ]
    )
"""


def launch_text(export: Export) -> str:
    """Return a Python launch file with a static transform publisher for each sensor.

    Metres and quaternions x, y, z, w of ``T_lidar_mag``, which turns a point given in the sensor's
    frame into the lidar's: parent is the lidar, child the sensor.
    """
    comments = (*export.origin, "The parent of every transform is the LiDAR, the child a sensor.")
    top = "\n".join(f"# {line}" for line in comments)
    nodes = "".join(_node(sensor, export.lidar_frame) for sensor in export.sensors)
    return top + HEAD + nodes + TAIL


def _node(sensor: ExportedSensor, lidar_frame: str) -> str:
    """Return the node of one sensor; the program itself gives it a name that is not taken."""
    arguments = "".join(
        f"                    {name!r}, {value!r},\n"
        for name, value in _arguments(sensor, lidar_frame).items()
    )
    return f"""            Node(
                package='tf2_ros',
                executable='static_transform_publisher',
                arguments=[
{arguments}                ],
            ),
"""


def _arguments(sensor: ExportedSensor, lidar_frame: str) -> dict[str, str]:
    transform = sensor.T_lidar_mag
    numbers = [*transform.t, *Rotation.from_matrix(transform.R).as_quat(canonical=True)]
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = {name: repr(float(number)) for name, number in zip(names, numbers, strict=True)}
    return {**values, "--frame-id": lidar_frame, "--child-frame-id": sensor.frame}


def _no_notes(_export: Export) -> tuple[str, ...]:
    return ()


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes
    ----------
    text
        The file of an export.
    fault
        What keeps a sensor out of it.
    notes
        What is worth a warning of the sensors that are in it.
    """

    text: Callable[[Export], str]
    fault: Fault = not_mounted
    notes: Callable[[Export], tuple[str, ...]] = _no_notes


FORMATS = {
    "ros2-launch": Format(launch_text),
    "urdf": Format(urdf_text),
    "kalibr": Format(kalibr_text),
    "json": Format(json_text),
    "bias-scale": Format(bias_scale_text, not_reducible, bias_scale_notes),
    "px4": Format(px4_text, px4_fault, autopilot_notes),
    "ardupilot": Format(ardupilot_text, ardupilot_fault, autopilot_notes),
}

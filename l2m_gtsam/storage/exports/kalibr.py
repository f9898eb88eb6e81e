"""Sensors as Kalibr writes its chains: 4 x 4 matrices from the reference to the sensor."""

from typing import Any

import numpy as np

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.storage.exports.export import Export, ExportedSensor
from l2m_gtsam.storage.yaml_file import yaml_text

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
    entry["T_mag_lidar"] = _homogeneous(sensor.T_lidar_mag.inverse())
    offset = sensor.calibration.time_offset
    if offset is not None and offset.estimated:
        entry["timeshift_mag_lidar"] = offset.seconds
    if not _split_by_frame(export):
        entry["rostopic"] = f"/{sensor.calibration.sensor}"
    return entry


def _split_by_frame(export: Export) -> bool:
    """Return whether sensors are named after frames, which says nothing of their topics."""
    bag = export.result.options.get("bag")
    return isinstance(bag, dict) and bool(bag.get("split_by_frame"))


def _homogeneous(transform: RigidTransform) -> list[list[float]]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = transform.R, transform.t
    return [[float(value) for value in row] for row in T]

"""Runs recorded under motion capture, and the map of one of them."""

from pathlib import Path

from l2m_gtsam.config import Config
from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.storage.bag import read_recording

BAG = {"fields": ["/imu/mag"], "poses": "/optitrack/pose"}
QUICK = {"sync": {"thin_distance_m": 0.05}, "windows": 2, "readings": 700, "modes": 150}


def read(folder: Path, run: int) -> Recording:
    config = Config.model_validate({"bag": BAG})
    return read_recording(folder / "bags" / f"optitrack_run{run}_ros1.bag", config.bag)


def mapped(recording: Recording, suite: CalibrationResult) -> FieldMap:
    (sensor,) = suite.sensors
    assert sensor.time_offset is not None
    known = KnownSensor(
        sensor.sensor, sensor.t_lidar_mag, sensor.distortion, sensor.time_offset.seconds
    )
    return map_recordings([recording], {known.sensor: known}, MappingOptions())

"""The map of a robot's passes by its first sensor."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.data import Distortion, KnownSensor, Recording
from l2m_gtsam.mapping.options import MappingOptions, SuiteCalibrationOptions
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.progress import silent
from l2m_gtsam.studies.slam_array.robot import SENSORS
from l2m_gtsam.upkeep.surveys import map_surveys


def map_by(passes: Sequence[Recording]) -> FieldMap:
    """Return the map of passes by their first sensor, which is calibrated from them."""
    alone = [replace(each, series=each.series[:1]) for each in passes]
    assumed = {SENSORS[0]: KnownSensor(SENSORS[0], np.zeros(3), Distortion.identity())}
    sensor = calibrate_suite(alone, assumed, SuiteCalibrationOptions(), silent).sensors[0]
    covariance = np.zeros((16, 16))
    covariance[:15, :15] = sensor.covariance
    offset = sensor.time_offset
    assert offset is not None
    covariance[15, 15] = offset.sigma**2
    covariance[:15, 15] = covariance[15, :15] = offset.cross_covariance
    known = KnownSensor(
        SENSORS[0], sensor.t_lidar_mag, sensor.distortion, offset.seconds, covariance
    )
    return map_surveys(alone, {SENSORS[0]: known}, MappingOptions(), ChangesOptions())

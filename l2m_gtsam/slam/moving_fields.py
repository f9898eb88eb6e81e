"""Readings without the fields of motors and the like, where a drive recorded their numbers."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FieldSeries, Recording, ScalarSeries
from l2m_gtsam.recording.regressors import ResampleOptions, resampled
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.solve.correction import without_moving


@dataclass(frozen=True)
class StillDrive:
    """A drive and the calibration of its sensors without fields that follow recorded numbers.

    Attributes
    ----------
    recording
        Readings without these fields; NaN where a number is not known.
    calibration
        ``moving`` is left only of sensors of which a number was not recorded.
    """

    recording: Recording
    calibration: CalibrationResult


def without_moving_fields(
    recording: Recording, calibration: CalibrationResult, options: ResampleOptions
) -> StillDrive:
    """Take off what follows recorded numbers. The sigmas of these fields do not count.

    Parameters
    ----------
    recording
        A drive with the numbers, by their names.
    calibration
        Of its sensors.
    options
        How far apart samples of a number may be.
    """
    numbers = {each.name: each for each in recording.scalars}
    entries = {
        each.sensor: each
        for each in calibration.sensors
        if each.moving and all(own.name in numbers for own in each.moving)
    }
    series = tuple(
        _still(each, entries[each.sensor], numbers, options) if each.sensor in entries else each
        for each in recording.series
    )
    sensors = tuple(
        replace(each, moving=()) if each.sensor in entries else each for each in calibration.sensors
    )
    return StillDrive(replace(recording, series=series), replace(calibration, sensors=sensors))


def _still(
    series: FieldSeries,
    sensor: SensorCalibration,
    numbers: dict[str, ScalarSeries],
    options: ResampleOptions,
) -> FieldSeries:
    own = [numbers[each.name] for each in sensor.moving]
    at = resampled(own, series.stamp_ns, options)
    field = without_moving(series.field, at.values, np.stack([each.h for each in sensor.moving]))
    field[~at.known] = np.nan
    return replace(series, field=field)

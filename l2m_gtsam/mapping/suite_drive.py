"""Drives of a suite as one, with what was assumed of its sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Readings, Recording, SyncCounts
from l2m_gtsam.errors import MapError
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.recording.joining import joined
from l2m_gtsam.recording.sync import stuck_sensors, synchronise, with_offsets

REACH = 5.0  # standard deviations of a clock for which readings need poses around them


@dataclass(frozen=True)
class SuiteDrive:
    """The drive of a suite: one recording, or several joined, and its readings with poses.

    ``assumed`` are the S sensors' parameters before the survey, shape (S, 16).
    """

    recording: Recording
    readings: Readings
    counts: tuple[SyncCounts, ...]
    assumed: FloatArray

    def at(self, offset: FloatArray) -> Readings:
        """Return the readings with the poses at their stamps and these clock offsets, (S,)."""
        return with_offsets(self.readings, self.recording.trajectory, offset)

    def of(self, recordings: Sequence[Recording], options: SuiteCalibrationOptions) -> "SuiteDrive":
        """Return other recordings of the same sensors as one drive."""
        names = self.readings.sensors
        assumed = {name: known_sensor(name, x) for name, x in zip(names, self.assumed, strict=True)}
        return suite_drive(recordings, assumed, options)


def suite_drive(
    recordings: Sequence[Recording],
    assumed: Mapping[str, KnownSensor] | None,
    options: SuiteCalibrationOptions,
) -> SuiteDrive:
    """Return drives of a suite as one, with readings that have poses whatever their clocks."""
    recording = joined(recordings)
    stated = [abs(each.time_offset) for each in (assumed or {}).values()]
    reach = REACH * options.clock_s + max(stated, default=0.0)
    synchronised = synchronise(recording, options.sync, reach)
    readings = synchronised.readings
    refuse_stuck(readings, recording)
    known = [(assumed or {}).get(name, KnownSensor.ideal(name)) for name in readings.sensors]
    start = np.stack([parameters_of(each) for each in known])
    return SuiteDrive(recording, readings, synchronised.counts, start)


def refuse_stuck(readings: Readings, recording: Recording) -> None:
    """Raise a MapError for a sensor that reports one constant value: it would poison the map."""
    if stuck := stuck_sensors(readings):
        raise MapError(
            f"{recording.source.path}: the sensor {readings.sensors[stuck[0]]!r} is stuck on one "
            "value; choose the others with `bag.fields`"
        )


def known_sensor(name: str, parameters: FloatArray) -> KnownSensor:
    """Return a sensor with (t, C row by row, H, time offset), shape (16,)."""
    distortion = Distortion.from_vector(parameters[3:15])
    return KnownSensor(name, parameters[:3], distortion, float(parameters[15]))


def parameters_of(sensor: KnownSensor) -> FloatArray:
    """Return (t, C row by row, H, time offset), shape (16,)."""
    return np.append(sensor.vector(), sensor.time_offset)

"""What every format is made from: the sensors that go into a file, their frames and the origin."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration, SensorStatus
from l2m_gtsam.records.verdict import judged_lines

Fault = Callable[[SensorCalibration], str | None]
"""Why a sensor cannot be part of a file, as half a sentence; None where it can."""


@dataclass(frozen=True)
class ExportedSensor:
    """A sensor that goes into a file.

    Attributes
    ----------
    frame
        Name of its frame.
    calibration
        All that is known of it.
    """

    frame: str
    calibration: SensorCalibration

    @property
    def T_lidar_mag(self) -> RigidTransform:
        """Pose of the sensor in the lidar frame, metres."""
        return RigidTransform(self.calibration.R_lidar_mag, self.calibration.t_lidar_mag)


@dataclass(frozen=True)
class Export:
    """A calibration as it is exported.

    Attributes
    ----------
    sensors
        Those that go into it, at least one.
    lidar_frame
        Name of the lidar's frame.
    left_out
        Why the others do not, by their names.
    result
        The whole calibration.
    """

    sensors: tuple[ExportedSensor, ...]
    lidar_frame: str
    left_out: Mapping[str, str]
    result: CalibrationResult

    @property
    def origin(self) -> tuple[str, ...]:
        """Where the file comes from, what is not in it and the verdict, a printable line each."""
        made_by = self.result.versions.get("l2m-gtsam", "")
        lines = [f"Magnetometers calibrated against a LiDAR by l2m_gtsam {made_by}".rstrip()]
        sources = [("drive", each) for each in self.result.drives]
        sources += [("map", self.result.map)] if self.result.map else []
        for name, source in sources:
            lines.append(f"{name}: {Path(source.path).name}, sha256 {source.sha256}")
        lines += [f"report id: {self.result.report_id}"] if self.result.report_id else []
        lines += [f"left out: {name}: {reason}" for name, reason in self.left_out.items()]
        lines += judged_lines(self.result.judgement)
        return tuple(_printable(line) for line in lines)


def not_mounted(sensor: SensorCalibration) -> str | None:
    """Return why the pose of a sensor on the lidar is not known."""
    if (reason := not_oriented(sensor)) is not None:
        return reason
    if not _known(sensor.t_lidar_mag, sensor.t_sigma):
        return _open(sensor, "position")
    return None


def not_oriented(sensor: SensorCalibration) -> str | None:
    """Return why the rotation of a sensor on the lidar is not known."""
    if (reason := _not_calibrated(sensor)) is not None:
        return reason
    if not _known(sensor.R_lidar_mag, np.diag(sensor.rotation_covariance)):
        return _open(sensor, "rotation")
    return None


def not_correctable(sensor: SensorCalibration) -> str | None:
    """Return why the readings of a sensor cannot be corrected."""
    if (reason := _not_calibrated(sensor)) is not None:
        return reason
    if not _known(sensor.distortion.C, sensor.C_sigma):
        return _open(sensor, "distortion C")
    if not _known(sensor.distortion.H, sensor.H_sigma):
        return _open(sensor, "offset H")
    return None


@dataclass(frozen=True)
class UsableSensors:
    """Sensors of a calibration that serve a purpose, and why the others do not, by name."""

    sensors: tuple[SensorCalibration, ...]
    left_out: Mapping[str, str]


def left_out_notes(left_out: Mapping[str, str]) -> tuple[str, ...]:
    """Return a sentence for each sensor that is not in a file."""
    return tuple(f"{name} is left out: {reason}" for name, reason in left_out.items())


def usable_sensors(result: CalibrationResult, fault: Fault) -> UsableSensors:
    """Return the sensors that nothing keeps out; a CalibrationError if there is none."""
    reasons = {sensor.sensor: fault(sensor) for sensor in result.sensors}
    left_out = {name: reason for name, reason in reasons.items() if reason is not None}
    chosen = tuple(sensor for sensor in result.sensors if sensor.sensor not in left_out)
    if not chosen:
        why = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:5])
        raise CalibrationError(f"no sensor is left to be written: {why or 'there is none'}")
    return UsableSensors(chosen, left_out)


def check_lidar_frame(name: str) -> None:
    """Raise a ConfigError for what tf or an XML file would not take as a frame's name."""
    if not _is_frame(name):
        raise ConfigError(f"--lidar-frame: {name!r} {_NO_FRAME}")


def export_of(
    result: CalibrationResult, fault: Fault, lidar_frame: str, frames: Mapping[str, str]
) -> Export:
    """Return the sensors of a calibration that can go into a file.

    Parameters
    ----------
    fault
        What keeps a sensor out of the format.
    lidar_frame
        Name of the lidar's frame.
    frames
        Names of sensors' frames; a sensor that is not named has its own name for it.

    Raises
    ------
    CalibrationError
        No sensor can be part of the file.
    ConfigError
        The name of a frame is not usable, belongs to two, or to a sensor that there is not.
    """
    names = [sensor.sensor for sensor in result.sensors]
    if unknown := [name for name in frames if name not in names]:
        accepted = ", ".join(names)
        raise ConfigError(f"--frame: no sensor {unknown[0]!r}; there are: {accepted}")
    usable = usable_sensors(result, fault)
    chosen = tuple(ExportedSensor(frames.get(s.sensor, s.sensor), s) for s in usable.sensors)
    _check_frames(chosen, lidar_frame)
    return Export(chosen, lidar_frame, usable.left_out, result)


def _check_frames(sensors: tuple[ExportedSensor, ...], lidar_frame: str) -> None:
    """Raise a ConfigError for names that cannot be used, or that clash."""
    check_lidar_frame(lidar_frame)
    owner = {lidar_frame: "the lidar"}
    for sensor in sensors:
        name = sensor.calibration.sensor
        if not _is_frame(sensor.frame):
            msg = f"sensor {name!r}: its frame {sensor.frame!r} {_NO_FRAME}; give it another"
            raise ConfigError(f"{msg} with --frame SENSOR=NAME")
        if sensor.frame in owner:
            raise ConfigError(
                f"sensor {name!r}: its frame {sensor.frame!r} is that of {owner[sensor.frame]}; "
                "give it another with --frame SENSOR=NAME"
            )
        owner[sensor.frame] = f"sensor {name!r}"


_NO_FRAME = "is no name of a frame (printable, without blanks, no slash in front)"


def _is_frame(name: str) -> bool:
    plain = name.isprintable() and not any(letter.isspace() for letter in name)
    return bool(name) and plain and not name.startswith("/")


def _not_calibrated(sensor: SensorCalibration) -> str | None:
    """Return why nothing of a sensor can be relied on; parts may be undetermined."""
    if sensor.status in (SensorStatus.SOLVED, SensorStatus.UNDETERMINED):
        return None
    return f"it is not calibrated ({sensor.status.value.replace('_', ' ')}): {sensor.message}"


def _known(values: FloatArray, spread: FloatArray) -> bool:
    return bool(np.isfinite(values).all() and np.isfinite(spread).all())


def _open(sensor: SensorCalibration, what: str) -> str:
    why = f": {sensor.undetermined[0]}" if sensor.undetermined else ""
    return f"its {what} is not determined{why}"


def _printable(line: str) -> str:
    """Return a line that stays one in every format, whatever a file's name holds."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(line.split()))

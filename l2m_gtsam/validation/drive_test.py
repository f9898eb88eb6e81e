"""What all sensors are tested on: a drive with a map, and what is taken off its readings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from l2m_gtsam.calibration.calibrate import prepare
from l2m_gtsam.calibration.extent import Extent, extent_of
from l2m_gtsam.calibration.offset_courses import ANYTHING_UT, Course, without_course
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import FloatArray, Readings, Recording, SaturatedAxis
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.qa.metrics.assemble import DRAWN, FEWEST, MOST
from l2m_gtsam.recording.saturation import saturation_sentence
from l2m_gtsam.recording.sync import stuck_sensors
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.error_budget import ErrorCause
from l2m_gtsam.records.validation import NotValidated, ValidatedSensor
from l2m_gtsam.solve.correction import without_moving
from l2m_gtsam.validation.displacement import SensorsOnDrive
from l2m_gtsam.validation.figures import Thinning, offset_s, sensor_figures
from l2m_gtsam.validation.innovation import KnownCalibration
from l2m_gtsam.validation.map_along_drive import along_drive
from l2m_gtsam.validation.recheck import SensorDrive, finite, recheck

# Of a map's errors: a test solves several graphs for each sensor.
MOST_WEIGHTS = 2500


@dataclass(frozen=True)
class DriveTest:
    """What all sensors are tested on.

    Attributes
    ----------
    recording, readings
        The drive, and what its sensors read with the poses.
    field_map
        The map, ready to be asked often along this drive.
    stuck
        Names of sensors that report one value.
    limits
        Of the range of each sensor, that readings exceed.
    options, chance
        As of `validate`.
    thinning
        How much of the drive is kept.
    extent
        Which of its readings count, where the drive crosses much of the map.
    courses
        Jumps and drifts of H that are taken off the readings.
    reads_as
        By the name of a sensor that of another, whose calibration its readings fit.
    """

    recording: Recording
    readings: Readings
    field_map: QueryableMap
    stuck: frozenset[str]
    limits: Mapping[str, tuple[SaturatedAxis, ...]]
    options: CalibrationOptions
    chance: float
    thinning: Thinning
    extent: Extent
    courses: tuple[Course, ...] = ()
    reads_as: Mapping[str, str] = field(default_factory=dict)

    def drive_of(self, sensor: SensorCalibration) -> SensorDrive:
        """Return a sensor, without what follows recorded numbers and courses of H."""
        own = without_numbers(self.readings, self.recording, sensor)
        for course in self.courses_of(sensor):
            own = without_course(own, course)
        known, poses = self.known(sensor), self.recording.trajectory
        return SensorDrive(own, poses, known, self.field_map, self.options.solve)

    def known(self, sensor: SensorCalibration) -> KnownCalibration:
        """Return its calibration; a course of H is a number whose field may be anything."""
        vector = np.append(sensor.vector(), offset_s(sensor))
        names = [each.name for each in self.recording.scalars]
        sigma = _of_numbers(names, {each.name: each.sigma for each in sensor.moving})
        anything = np.full((len(self.courses_of(sensor)), 3), ANYTHING_UT)
        return KnownCalibration(vector, sensor.noise, np.concatenate([sigma, anything]))

    def courses_of(self, sensor: SensorCalibration) -> tuple[Course, ...]:
        """Return the jumps and drifts of a sensor."""
        return tuple(each for each in self.courses if each.sensor == sensor.sensor)

    def on_drive(self, known: Sequence[SensorCalibration]) -> SensorsOnDrive:
        """Return sensors with their calibrations."""
        return SensorsOnDrive(
            tuple(map(self.drive_of, known)),
            tuple(finite(joint_covariance(each), self.options.solve) for each in known),
            tuple(map(alike_share, known)),
        )


def drive_test(
    recording: Recording,
    field_map: QueryableMap,
    known: Sequence[SensorCalibration],
    options: CalibrationOptions,
    chance: float,
) -> DriveTest:
    """Return what sensors that are known are tested on; others take no part."""
    shared = {each.sensor for each in known}
    kept = tuple(each for each in recording.series if each.sensor in shared)
    synchronised = prepare(replace(recording, series=kept), options)
    readings = synchronised.readings
    places = {each.sensor: each.t_lidar_mag for each in known}
    t = np.array([places[name] for name in readings.sensors])
    solver_map = for_solvers(field_map)
    extent = extent_of(readings, solver_map, t, MOST_WEIGHTS)
    readings = readings.select(extent.counts)
    pairs = zip(readings.sensors, synchronised.counts, strict=True)
    return DriveTest(
        recording=recording,
        readings=readings,
        field_map=along_drive(solver_map),
        stuck=frozenset(readings.sensors[k] for k in stuck_sensors(readings)),
        limits={name: counts.limits for name, counts in pairs},
        options=options,
        chance=chance,
        thinning=Thinning(
            readings.stamp_ns.min(keepdims=True), int(np.clip(DRAWN // len(known), FEWEST, MOST))
        ),
        extent=extent,
    )


def tested(test: DriveTest, sensor: SensorCalibration) -> ValidatedSensor | NotValidated:
    """Return one sensor tested on the drive, or why it cannot be."""
    drive, limits = test.drive_of(sensor), test.limits[sensor.sensor]
    if reason := _why_untested(drive, sensor.sensor in test.stuck):
        beyond = f"{saturation_sentence(limits)}. " if limits else ""
        return NotValidated(sensor.sensor, f"{beyond}{reason}", faulty=True)
    found = recheck(drive, joint_covariance(sensor), test.chance)
    figures = sensor_figures(drive, sensor, found, test.thinning, test.chance)
    return replace(figures, limits=limits, reads_as=test.reads_as.get(sensor.sensor, ""))


def _why_untested(drive: SensorDrive, stuck: bool) -> str:
    """Return why a sensor cannot be tested; empty if it can."""
    count, needed = len(drive.timed), drive.options.min_readings
    if stuck:
        return "It reports one constant value: it is stuck."
    if count < needed:
        return f"Only {count} of its readings have a pose; at least {needed} are needed."
    within = int(drive.inside().sum())
    if within < needed:
        return (
            f"{count - within} of its {count} readings lie outside the map; at least "
            f"{needed} must lie inside. Is it the map of this place, and are the poses in its "
            "frame?"
        )
    return ""


def without_numbers(
    readings: Readings, recording: Recording, sensor: SensorCalibration
) -> Readings:
    """Return what one sensor read, without what follows recorded numbers.

    Raises
    ------
    ConfigError
        Such a number was not recorded.
    """
    own = readings.alone(readings.sensors.index(sensor.sensor))
    names = [each.name for each in recording.scalars]
    if unknown := [each.name for each in sensor.moving if each.name not in names]:
        raise ConfigError(
            f"a part of the readings of {sensor.sensor} follows {unknown[0]!r}, which "
            "`bag.regressors` does not name; say in --config where it is recorded"
        )
    if own.regressors is None or not sensor.moving:
        return own
    h = _of_numbers(names, {each.name: each.h for each in sensor.moving})
    return replace(own, field=without_moving(own.field, own.regressors, h))


def _of_numbers(names: Sequence[str], values: dict[str, FloatArray]) -> FloatArray:
    """Return a vector for each number, zero where there is none, shape (K, 3)."""
    rows = [values.get(name, np.zeros(3)) for name in names]
    return np.reshape(np.array(rows, dtype=float), (-1, 3))


def joint_covariance(sensor: SensorCalibration) -> FloatArray:
    """Return the covariance of (t, C row by row, H, time offset), shape (16, 16).

    The variance of a time offset that was held, or that the file does not have, is infinite:
    nothing is known of that clock.
    """
    joint = np.zeros((16, 16))
    joint[:15, :15] = sensor.covariance
    joint[15, 15] = np.inf
    offset = sensor.time_offset
    if offset is not None and offset.estimated:
        joint[15, :15] = joint[:15, 15] = offset.cross_covariance
        joint[15, 15] = offset.sigma**2
    return joint


def alike_share(sensor: SensorCalibration) -> float:
    """Return the share of the variances of a calibration that others may have in common with it.

    All but the noise of the readings; all, where the file does not tell.
    """
    own = [each for each in sensor.variance_shares if each.cause is ErrorCause.NOISE]
    return 1 - min((share for each in own for share in (each.t, each.C, each.H)), default=0.0)

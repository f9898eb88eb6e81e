"""Options of the validation study, a hall with a calibrated vehicle, and drives after a change."""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import (
    Distortion,
    FloatArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.options import Options
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.simulate.hall_drives import CLEARANCE_M, CalibrationDrive, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import SteelHall, steel_hall
from l2m_gtsam.simulate.world import SteelWorld, brought_steel, place_beside
from l2m_gtsam.studies.honesty.drives import drive_seed


class TrueCause(StrEnum):
    """What changed since the calibration."""

    NOTHING = "nothing"
    """Nothing."""
    PLACE = "place"
    """Steel was brought beside the path."""
    TURNED = "turned"
    """The mount of all sensors was turned."""
    IRON = "iron"
    """Iron on the vehicle: hard iron at all sensors."""
    BOTH = "both"
    """Steel beside the path, and iron on the vehicle."""
    SENSOR = "sensor"
    """One sensor was turned in its place."""
    ELSEWHERE = "elsewhere"
    """Nothing, but the drive is through another hall than the map."""


class ValidationStudyOptions(Options):
    """Size and conditions of the study."""

    seed: int = Field(default=900, ge=0)
    """Of the first hall; the others follow it one by one."""
    halls: int = Field(default=20, ge=1)
    """Each with its map, its vehicle and its calibration."""
    cases: int = Field(default=2, ge=0)
    """Drives of a hall, each with the next of all changes."""
    unchanged: int = Field(default=3, ge=0)
    """Drives of a hall on which nothing has changed."""
    sensors: int = Field(default=3, ge=1)
    """Of a vehicle, at random places and with random distortions."""
    noise: float = Field(default=0.2, gt=0)
    """Of survey and drives alike in uT."""
    readings: int = Field(default=600, ge=100)
    """Of each sensor of a drive."""
    heights: tuple[float, ...] = Field(default=(0.4, 0.7, 1.0), min_length=1)
    """Passes of a survey over the floor in metres; sensors sit between them."""
    survey_readings: int = Field(default=1500, ge=30)
    """Of a survey."""
    moment: tuple[float, float] = (10.0, 50.0)
    """Of the steel that is brought, from and to in A m^2."""
    distance: tuple[float, float] = (0.5, 1.0)
    """Of it from the path of the sensors in metres."""
    edges: tuple[float, float, float] = (0.3, 0.3, 0.8)
    """Its length along each axis in metres."""
    turn_deg: tuple[float, float] = (1.0, 4.0)
    """By how much a mount, or one sensor, is turned about a random axis."""
    iron_ut: tuple[float, float] = (1.0, 5.0)
    """Size of the vehicle's new hard iron at each sensor, in a random direction."""
    map: MapOptions = MapOptions()
    """How the map is made of the survey, and of the structure that the LiDAR saw."""


FASTEST_M_S = 1.0
SECONDS = 1e-9
ANOTHER = 10_000  # seeds after a hall's own: of the hall where a drive elsewhere is
NO_STEEL = brought_steel(np.zeros((0, 3)), np.zeros((0, 3)), np.ones(3))


@dataclass(frozen=True)
class CalibratedHall:
    """A hall with the map of its survey, and a vehicle that was calibrated there.

    Attributes
    ----------
    hall
        The truth.
    seed
        Of it.
    field_map
        Of its survey.
    sensors
        The vehicle's, as they truly were when they were calibrated.
    calibration
        Of them, on a drive of its own.
    """

    hall: SteelHall
    seed: int
    field_map: QueryableMap
    sensors: tuple[KnownSensor, ...]
    calibration: CalibrationResult


def calibrated_hall(options: ValidationStudyOptions, number: int) -> CalibratedHall:
    """Return a hall by its number with its calibrated vehicle."""
    seed = options.seed + number
    hall = steel_hall(seed)
    read = survey(hall, seed, options.heights, options.noise, options.survey_readings)
    learnt = build_map(read.points, read.field, options.map, hall.cloud())
    field_map = for_solvers(learnt)
    span = min(options.heights), max(options.heights)
    sensors = calibration_drive(hall, seed, span, options.noise, options.sensors, 30).sensors
    path = path_of(options, hall, drive_seed(seed, 0))
    first = recorded(options, hall, path, sensors, NO_STEEL)
    calibration = calibrate(first, field_map, CalibrationOptions())
    return CalibratedHall(hall, seed, field_map, sensors, calibration)


@dataclass(frozen=True)
class ChangedDrive:
    """A drive after something changed, and where the steel was brought, if any, metres, (3,)."""

    recording: Recording
    steel: FloatArray | None


@dataclass(frozen=True)
class HallPath:
    """The poses of a drive, and the seed of all that is random on it."""

    trajectory: Trajectory
    seed: int


def path_of(options: ValidationStudyOptions, hall: SteelHall, seed: int) -> HallPath:
    """Return a path through a hall, as fast as a vehicle that bends around what is in its way."""
    span = min(options.heights), max(options.heights)
    drive = calibration_drive(hall, seed, span, options.noise, 1, options.readings)
    return HallPath(driven_at(drive.trajectory, FASTEST_M_S), seed)


def driven_at(poses: Trajectory, fastest: float) -> Trajectory:
    """Return poses with stamps later where a step takes longer at a speed in m/s.

    Poses that are pushed out of a structure jump from one side of it to the other: in the time of
    one step that would be 30 m/s, and the clock of a sensor would hang on these poses alone.
    """
    step = np.diff(poses.stamp_ns)
    least = np.linalg.norm(np.diff(poses.p, axis=0), axis=1) / fastest / SECONDS
    longer = np.maximum(step, np.ceil(least).astype(np.int64))
    return replace(poses, stamp_ns=poses.stamp_ns[0] + np.cumsum(np.append(0, longer)))


def recorded(
    options: ValidationStudyOptions,
    hall: SteelHall,
    path: HallPath,
    sensors: tuple[KnownSensor, ...],
    steel: SteelWorld,
) -> Recording:
    """Return what sensors read on a path through a hall and the steel that was brought to it."""
    drive = CalibrationDrive.along(
        path.trajectory,
        sensors,
        partial(hall.free, clearance=CLEARANCE_M),
        lambda x: hall.world.field(x) + steel.field(x),
        options.noise,
        options.readings,
        np.random.default_rng([path.seed, 21]),
    )
    return drive.recording(SourceFile(f"drive-{path.seed}", str(path.seed)))


def changed_drive(
    options: ValidationStudyOptions, place: CalibratedHall, change: TrueCause, number: int
) -> ChangedDrive:
    """Return a drive by its number, from 1, after something changed."""
    seed = drive_seed(place.seed, number)
    hall = place.hall if change is not TrueCause.ELSEWHERE else steel_hall(place.seed + ANOTHER)
    path = path_of(options, hall, seed)
    rng, steel, at = np.random.default_rng([seed, 22]), NO_STEEL, None
    sensors = altered(options, place.sensors, change, rng)
    if change in (TrueCause.PLACE, TrueCause.BOTH):
        poses = path.trajectory
        x = poses.R @ np.mean([each.t_lidar_mag for each in sensors], axis=0) + poses.p
        free = x[hall.free(x, CLEARANCE_M)]
        at = place_beside(free, np.zeros((0, 3)), rng.uniform(*options.distance), rng)
        moment = np.exp(rng.uniform(*np.log(options.moment))) * direction(rng)
        steel = brought_steel(at[None], moment[None], np.array(options.edges))
    return ChangedDrive(recorded(options, hall, path, sensors, steel), at)


def altered(
    options: ValidationStudyOptions,
    sensors: tuple[KnownSensor, ...],
    change: TrueCause,
    rng: np.random.Generator,
) -> tuple[KnownSensor, ...]:
    """Return the sensors after a change of the vehicle, or of the last of them."""
    turn = np.deg2rad(rng.uniform(*options.turn_deg)) * direction(rng)
    if change is TrueCause.TURNED:
        R = Rotation.from_rotvec(turn).as_matrix()
        middle = np.mean([each.t_lidar_mag for each in sensors], axis=0)
        places = [middle + R @ (each.t_lidar_mag - middle) for each in sensors]
        return tuple(
            replace(each, t_lidar_mag=t, distortion=_in(each, R))
            for each, t in zip(sensors, places, strict=True)
        )
    if change is TrueCause.SENSOR:
        R = Rotation.from_rotvec(turn).as_matrix()
        return (*sensors[:-1], replace(sensors[-1], distortion=_in(sensors[-1], R)))
    if change in (TrueCause.IRON, TrueCause.BOTH):
        return tuple(
            replace(each, distortion=_offset(each, rng.uniform(*options.iron_ut) * direction(rng)))
            for each in sensors
        )
    return sensors


def direction(rng: np.random.Generator) -> FloatArray:
    """Return a random unit vector, shape (3,)."""
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _in(sensor: KnownSensor, R: FloatArray) -> Distortion:
    """Return the distortion of a sensor that is turned by R in the lidar frame."""
    return replace(sensor.distortion, C=sensor.distortion.C @ R.T)


def _offset(sensor: KnownSensor, field: FloatArray) -> Distortion:
    return replace(sensor.distortion, H=sensor.distortion.H + field)

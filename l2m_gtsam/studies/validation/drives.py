"""A hall with its map and a calibrated vehicle, and drives after something changed."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import calibrate
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.calibration.view import Compilable, QueryableMap
from l2m_gtsam.data import (
    Distortion,
    FieldSeries,
    FloatArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.simulate.brought_steel import brought_steel, place_beside
from l2m_gtsam.simulate.hall_drives import CLEARANCE_M, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import CloudVariant, SteelHall, hall_cloud, steel_hall
from l2m_gtsam.simulate.world import SteelWorld
from l2m_gtsam.studies.honesty.drives import drive_seed
from l2m_gtsam.studies.validation.options import TrueCause, ValidationStudyOptions

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
    cloud = hall_cloud(hall, CloudVariant.ACCURATE, seed)
    learnt = build_map(read.points, read.field, options.map, cloud)
    field_map = learnt.compile() if isinstance(learnt, Compilable) else learnt
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
    """Return a path through a hall."""
    span = min(options.heights), max(options.heights)
    drive = calibration_drive(hall, seed, span, options.noise, 1, options.readings)
    return HallPath(drive.trajectory, seed)


def recorded(
    options: ValidationStudyOptions,
    hall: SteelHall,
    path: HallPath,
    sensors: tuple[KnownSensor, ...],
    steel: SteelWorld,
) -> Recording:
    """Return what sensors read on a path through a hall and the steel that was brought to it."""
    poses, series = path.trajectory, []
    rng = np.random.default_rng([path.seed, 21])
    for sensor in sensors:
        x = poses.R @ sensor.t_lidar_mag + poses.p
        free = np.flatnonzero(hall.free(x, CLEARANCE_M))
        rows = free[np.linspace(0, len(free) - 1, options.readings).round().astype(np.int64)]
        B = hall.world.field(x[rows]) + steel.field(x[rows])
        b_lidar = np.einsum("nji,nj->ni", poses.R[rows], B)
        field = sensor.distortion.apply(b_lidar) + options.noise * rng.standard_normal(B.shape)
        name = sensor.sensor
        series.append(FieldSeries(name, f"/{name}", name, poses.stamp_ns[rows], field))
    return Recording(poses, tuple(series), SourceFile(f"drive-{path.seed}", str(path.seed)))


def changed_drive(
    options: ValidationStudyOptions, place: CalibratedHall, change: TrueCause, number: int
) -> ChangedDrive:
    """Return a drive by its number, from 1, after something changed."""
    seed = drive_seed(place.seed, number)
    path = path_of(options, place.hall, seed)
    rng, steel, at = np.random.default_rng([seed, 22]), NO_STEEL, None
    sensors = altered(options, place.sensors, change, rng)
    if change in (TrueCause.PLACE, TrueCause.BOTH):
        poses = path.trajectory
        x = poses.R @ np.mean([each.t_lidar_mag for each in sensors], axis=0) + poses.p
        free = x[place.hall.free(x, CLEARANCE_M)]
        at = place_beside(free, np.zeros((0, 3)), rng.uniform(*options.distance), rng)
        moment = np.exp(rng.uniform(*np.log(options.moment))) * direction(rng)
        steel = brought_steel(at[None], moment[None], np.array(options.edges))
    return ChangedDrive(recorded(options, place.hall, path, sensors, steel), at)


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

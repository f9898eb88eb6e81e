"""Options, halls and drives of the honesty study, and what is wrong on troubled drives."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.maps.build import MapOptions, build_map
from l2m_gtsam.options import Options
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions, pose_roots
from l2m_gtsam.recording.sync import with_offsets
from l2m_gtsam.simulate.hall_drives import STEP_NS, CalibrationDrive, calibration_drive, survey
from l2m_gtsam.simulate.sensors import lasting
from l2m_gtsam.simulate.steel_hall import SteelHall, steel_hall

START = 6  # a stream of randomness
DRIVES_OF_A_HALL = 1000  # at most; no two drives of a study are alike
SHARE = 0.1  # of the readings
LATE_S = 0.04  # clocks are off by up to this
FASTEST_M_S, FASTEST_RAD_S = 1.0, 1.0
POSE_NOISE = PoseNoiseOptions(position_m=0.005, rotation_deg=0.1, correlation_s=1.0)
Noise = Annotated[float, Field(gt=0)]


class Condition(StrEnum):
    """What goes wrong on a drive beside noise."""

    CLEAN = "clean"
    """Nothing."""
    TROUBLED = "troubled"
    """Clocks are off, poses are wrong by errors that last, a tenth of the readings is spoilt."""


class HonestyOptions(Options):
    """Size and conditions of the study."""

    seed: int = Field(default=100, ge=0)
    """Of the first hall; the others follow it one by one."""
    surveys: int = Field(default=20, ge=2)
    """Halls at each noise level, each with its survey and map: what is independent."""
    drives: int = Field(default=10, ge=1)
    """On each map, each with a sensor of random place and distortion."""
    noises: tuple[Noise, ...] = Field(default=(0.1, 0.2, 0.5), min_length=1)
    """Of survey and drives alike in uT, for drives on which nothing else is wrong."""
    troubled_noises: tuple[Noise, ...] = (0.2,)
    """The same for drives on which everything is wrong."""
    readings: int = Field(default=220, ge=30)
    """Of a drive."""
    heights: tuple[float, ...] = Field(default=(0.4, 0.7, 1.0), min_length=1)
    """Passes of a survey over the floor in metres; sensors sit between the lowest and the
    highest."""
    survey_readings: int = Field(default=1500, ge=30)
    """Of a survey."""
    start: float = Field(default=0.05, gt=0)
    """Each axis of a start is at most so many metres off: the basin is another study."""
    map: MapOptions = MapOptions()
    """How the map is made of the survey, and of the structure that the LiDAR saw."""
    solve: OneKeyOptions = OneKeyOptions(pose_noise=POSE_NOISE)
    """How a calibration is solved; its `uncertainty` is set to each kind in turn."""

    @field_validator("map")
    @classmethod
    def _knows_its_errors(cls, chosen: MapOptions) -> MapOptions:
        if chosen.kind != "harmonic":
            raise ValueError(f"kind {chosen.kind} does not know its errors; accepted: harmonic")
        return chosen


@dataclass(frozen=True)
class Disturbed:
    """A drive with something wrong, and by how much each reading is off in uT, shape (N,)."""

    drive: CalibrationDrive
    change: FloatArray


@dataclass(frozen=True)
class MappedHall:
    """A hall and the map of its survey.

    Attributes
    ----------
    hall
        The truth.
    noise
        Of its survey and drives in uT.
    field_map
        What calibrations are given.
    """

    hall: SteelHall
    seed: int
    noise: float
    field_map: QueryableMap


def mapped_hall(options: HonestyOptions, noise: float, number: int) -> MappedHall:
    """Return a hall by its number, mapped with this noise in uT."""
    seed = options.seed + number
    hall = steel_hall(seed)
    read = survey(hall, seed, options.heights, noise, options.survey_readings)
    learnt = build_map(read.points, read.field, options.map, hall.cloud())
    return MappedHall(hall, seed, noise, for_solvers(learnt))


def drive_through(
    options: HonestyOptions, hall: MappedHall, condition: Condition, number: int
) -> Disturbed:
    """Return a drive by its number, the same but for what goes wrong under each condition."""
    own = drive_seed(hall.seed, number)
    span = (min(options.heights), max(options.heights))
    drive = calibration_drive(hall.hall, own, span, hall.noise, 1, options.readings)
    if condition is Condition.TROUBLED:
        return troubled(drive, own)
    return Disturbed(drive, np.zeros(len(drive.readings)))


def drive_seed(hall: int, number: int) -> int:
    """Return the seed of a drive through the hall of a seed."""
    return DRIVES_OF_A_HALL * hall + number


def start_near(drive: CalibrationDrive, hall: int, number: int, most: float) -> FloatArray:
    """Return starts, each axis at most so many metres off the truth, shape (S, 3)."""
    rng = np.random.default_rng([hall, number, START])
    away = rng.uniform(-most, most, (len(drive.sensors), 3))
    return np.asarray(drive.truth()[:, :3] + away)


def disturbed(drive: CalibrationDrive, change: FloatArray) -> Disturbed:
    """Return the drive with changes in uT, shape (N, 3), added to its readings."""
    readings = replace(drive.readings, field=drive.readings.field + change)
    return Disturbed(replace(drive, readings=readings), np.linalg.norm(change, axis=1))


def spikes(drive: CalibrationDrive, seed: int) -> Disturbed:
    """Return a drive of which a tenth of the readings is off by tens of microtesla."""
    rng = np.random.default_rng([seed, 1])
    wrong = rng.random(len(drive.readings)) < SHARE
    return disturbed(drive, wrong[:, None] * 50 * rng.standard_normal((len(wrong), 3)))


def troubled(drive: CalibrationDrive, seed: int) -> Disturbed:
    """Return a drive with clocks, poses and a tenth of its readings wrong."""
    spiked = spikes(driven(drive), seed)
    late, rng = mistimed(spiked.drive, seed), np.random.default_rng([seed, 8])
    poses = misplaced(late.trajectory, POSE_NOISE, rng)
    return replace(spiked, drive=placed(replace(late, trajectory=poses)))


def driven(drive: CalibrationDrive) -> CalibrationDrive:
    """Return a drive at the speeds of a vehicle: the paths of halls jump round what is in the way.

    The vehicle goes on in a straight line and turns at a constant rate from pose to pose.
    """
    path = drive.trajectory
    way = np.linalg.norm(np.diff(path.p, axis=0), axis=1) / FASTEST_M_S
    between = path.R[:-1].transpose(0, 2, 1) @ path.R[1:]
    turn = Rotation.from_matrix(between).magnitude() / FASTEST_RAD_S
    # Each step takes as long as its slower part, moving or turning.
    step = np.maximum(np.maximum(way, turn), 1e-9 * STEP_NS)
    stamps = np.round(1e9 * np.concatenate([[0.0], np.cumsum(step)])).astype(np.int64)
    readings = replace(drive.readings, stamp_ns=stamps[drive.readings.stamp_ns // STEP_NS])
    return placed(replace(drive, readings=readings, trajectory=replace(path, stamp_ns=stamps)))


def mistimed(drive: CalibrationDrive, seed: int) -> CalibrationDrive:
    """Return a drive whose sensors' clocks are off: the true pose is that at stamp + offset."""
    rng = np.random.default_rng([seed, 7])
    offset = rng.uniform(-LATE_S, LATE_S, len(drive.sensors))
    late = np.round(1e9 * offset).astype(np.int64)[drive.readings.sensor]
    readings = replace(drive.readings, stamp_ns=drive.readings.stamp_ns - late)
    return placed(replace(drive, readings=readings, offset=offset))


def misplaced(true: Trajectory, noise: PoseNoiseOptions, rng: np.random.Generator) -> Trajectory:
    """Return poses that are wrong by errors that last: true = measured Exp(error)."""
    sigmas = np.repeat([np.deg2rad(noise.rotation_deg or 0), noise.position_m or 0], 3)
    white = sigmas * rng.standard_normal((len(true), 6))
    turn, shift = np.split(lasting(white, true.stamp_ns, noise.lasting_s), 2, axis=1)
    R = true.R @ Rotation.from_rotvec(-turn).as_matrix()
    return replace(true, R=R, p=true.p - np.einsum("nij,nj->ni", R, shift))


def placed(drive: CalibrationDrive) -> CalibrationDrive:
    """Return a drive with poses as its trajectory has them at the readings' stamps."""
    nothing = np.zeros(len(drive.sensors))
    readings: Readings = with_offsets(drive.readings, drive.trajectory, nothing)
    roots = pose_roots(drive.trajectory, readings.stamp_ns, POSE_NOISE)
    return replace(drive, readings=replace(readings, pose_root=roots))

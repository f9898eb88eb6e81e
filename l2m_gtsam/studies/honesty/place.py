"""Where calibrations are judged: a hall with the map of its survey, and drives through it."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.view import Compilable, QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.simulate.hall_drives import CalibrationDrive, calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import CloudVariant, SteelHall, hall_cloud, steel_hall
from l2m_gtsam.studies.honesty.conditions import Condition, HonestyOptions
from l2m_gtsam.studies.honesty.trouble import Disturbed, troubled

START = 6  # a stream of randomness
DRIVES_OF_A_HALL = 1000  # at most; no two drives of a study are alike


@dataclass(frozen=True)
class Place:
    """A hall and the map of its survey.

    Attributes
    ----------
    hall
        The truth.
    seed
        Of the hall.
    noise
        Of its survey and drives in uT.
    field_map
        What calibrations are given.
    """

    hall: SteelHall
    seed: int
    noise: float
    field_map: QueryableMap


def surveyed_hall(options: HonestyOptions, noise: float, number: int) -> Place:
    """Return a hall by its number, mapped with this noise in uT."""
    seed = options.seed + number
    hall = steel_hall(seed)
    read = survey(hall, seed, options.heights, noise, options.survey_readings)
    cloud = hall_cloud(hall, CloudVariant.ACCURATE, seed)
    learnt = build_map(read.points, read.field, options.map, cloud)
    compiled = learnt.compile() if isinstance(learnt, Compilable) else learnt
    return Place(hall, seed, noise, compiled)


def drive_through(
    options: HonestyOptions, place: Place, condition: Condition, number: int
) -> Disturbed:
    """Return a drive by its number, the same but for what goes wrong under each condition."""
    own = drive_seed(place.seed, number)
    span = (min(options.heights), max(options.heights))
    drive = calibration_drive(place.hall, own, span, place.noise, 1, options.readings)
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

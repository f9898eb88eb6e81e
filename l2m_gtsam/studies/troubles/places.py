"""The two kinds of places that are surveyed, which share no code of their fields."""

from dataclasses import dataclass
from typing import Protocol

from l2m_gtsam.data import FloatArray
from l2m_gtsam.simulate.hall_drives import CalibrationDrive, calibration_drive, survey
from l2m_gtsam.simulate.office_corridor import OfficeCorridor, office_corridor
from l2m_gtsam.simulate.office_drives import office_drive, survey_way
from l2m_gtsam.simulate.steel_hall import CloudVariant, SteelHall, hall_cloud, steel_hall
from l2m_gtsam.studies.troubles.options import TroublesOptions, World

SENSORS = 2


class Place(Protocol):
    """A place of which everything is known."""

    @property
    def seed(self) -> int:
        """That it comes from."""

    def field(self, points: FloatArray, /) -> FloatArray:
        """Return the field in the map frame at points (N, 3) in uT, shape (N, 3)."""

    def floor(self, xy: FloatArray, /) -> FloatArray:
        """Return the height of the floor at places (N, 2) in metres, shape (N,)."""

    def cloud(self) -> FloatArray:
        """Return what a LiDAR saw of the steel, shape (M, 3), metres."""

    def survey_way(self, options: TroublesOptions, /) -> FloatArray:
        """Return where the sensors of a survey read, a pass for each height, shape (N, 3)."""

    def drive(self, options: TroublesOptions, seed: int, /) -> CalibrationDrive:
        """Return a drive of two sensors without any trouble."""


@dataclass(frozen=True)
class Hall:
    """A hall of magnetised cuboids."""

    hall: SteelHall
    seed: int

    def field(self, points: FloatArray) -> FloatArray:
        """Return the field, shape (N, 3)."""
        return self.hall.world.field(points)

    def floor(self, xy: FloatArray) -> FloatArray:
        """Return the height of the floor, shape (N,)."""
        return self.hall.floor.height(xy)

    def cloud(self) -> FloatArray:
        """Return posts and racks."""
        return hall_cloud(self.hall, CloudVariant.ACCURATE, self.seed)

    def survey_way(self, options: TroublesOptions) -> FloatArray:
        """Return lanes over the floor."""
        chosen = options.heights, options.noise, options.survey_readings
        return survey(self.hall, self.seed, *chosen).points

    def drive(self, options: TroublesOptions, seed: int) -> CalibrationDrive:
        """Return a drive round posts and racks."""
        span = (min(options.heights), max(options.heights))
        return calibration_drive(self.hall, seed, span, options.noise, SENSORS, options.readings)


@dataclass(frozen=True)
class Corridor:
    """An office corridor of rods and sheets."""

    office: OfficeCorridor
    seed: int

    def field(self, points: FloatArray) -> FloatArray:
        """Return the field, shape (N, 3)."""
        return self.office.field(points)

    def floor(self, xy: FloatArray) -> FloatArray:
        """Return the height of the floor, shape (N,)."""
        return self.office.height(xy)

    def cloud(self) -> FloatArray:
        """Return door frames, lift doors, radiators and cable trays."""
        return self.office.cloud()

    def survey_way(self, options: TroublesOptions) -> FloatArray:
        """Return lanes to and fro."""
        return survey_way(self.office, self.seed, options.heights, options.survey_readings)

    def drive(self, options: TroublesOptions, seed: int) -> CalibrationDrive:
        """Return a drive to and fro."""
        span = (min(options.heights), max(options.heights))
        return office_drive(self.office, seed, span, options.noise, SENSORS, options.readings)


def place_of(world: World, seed: int) -> Place:
    """Return a place of a kind by its seed."""
    if world is World.HALL:
        return Hall(steel_hall(seed), seed)
    return Corridor(office_corridor(seed), seed)

"""Loads of a hall: steel that stands there when it is surveyed, and when it is driven through.

Loads stand on the timber structures, which vehicles keep away from, and outside of the area.
"""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import FloatArray, KnownSensor, joined_rows
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.simulate.hall_drives import calibration_drive, survey
from l2m_gtsam.simulate.steel_hall import (
    HALF_AREA,
    Boxes,
    SteelHall,
    SteelStructure,
    steel_hall,
)
from l2m_gtsam.simulate.world import SteelWorld, brought_steel
from l2m_gtsam.studies.validation.drives import ValidationStudyOptions, direction


class ChangesStudyOptions(ValidationStudyOptions):
    """Size and conditions of the study."""

    seed: int = Field(default=1200, ge=0)
    """Of the first hall; the others follow it one by one."""
    paths: int = Field(default=2, ge=1, le=2)
    """Through each hall, each driven with and without changes."""
    unchanged: int = Field(default=6, ge=0)
    """Further drives through each hall in which nothing has changed: for false alarms."""
    sensors: int = Field(default=2, ge=1)
    """Of a vehicle, at random places and with random distortions."""
    moment: tuple[float, float] = (1.0, 50.0)
    """Of steel that comes or goes, from and to in A m^2."""
    edges: tuple[float, float, float] = (0.2, 0.2, 0.2)
    """Its length along each axis in metres."""
    heights_of_steel: tuple[float, float] = (0.2, 2.0)
    """Over the floor, from and to in metres."""
    beyond: tuple[float, float] = (0.3, 2.5)
    """Of steel outside of the area: over its border, from and to in metres."""


FLOOR_M, AROUND_M = 0.1, 1.0  # between points of the floor; beyond the area
# Of the loads on timber, those that stand there when the hall is surveyed.
STANDING = (1, 2, 4)
# What happens to loads before each path: comes, goes, is moved outside, comes outside.
STEPS = ((0, 1, 2), (3, 4, 1))


@dataclass(frozen=True)
class Loads:
    """Steel that comes and goes: places in metres, (K, 3), and moments in A m^2, (K, 3)."""

    positions: FloatArray
    moments: FloatArray

    def __len__(self) -> int:
        return len(self.positions)

    def steel(self, options: ChangesStudyOptions) -> SteelWorld:
        """Return it as bodies."""
        return brought_steel(self.positions, self.moments, np.array(options.edges))


@dataclass(frozen=True)
class LoadedHall:
    """A hall with loads, mapped, and a vehicle.

    Attributes
    ----------
    hall
        With the loads that stood there when it was surveyed.
    seed
        Of it.
    field_map
        Of its survey.
    sensors
        The vehicle's.
    changes
        For each path: sources that came, those that went with the opposite of their moment.
    """

    hall: SteelHall
    seed: int
    field_map: QueryableMap
    sensors: tuple[KnownSensor, ...]
    changes: tuple[Loads, ...]


def loaded_hall(options: ChangesStudyOptions, number: int) -> LoadedHall:
    """Return a hall by its number."""
    seed = options.seed + number
    rng, bare = np.random.default_rng([seed, 31]), steel_hall(seed)
    timber = np.array([each.centre for each in bare.timber])
    height = rng.uniform(*options.heights_of_steel, len(timber))
    inside = Loads(np.column_stack([timber, height]), drawn(options, len(timber), rng))
    standing = list(STANDING)
    stood = Loads(inside.positions[standing], inside.moments[standing]).steel(options)
    hall = replace(bare, world=joined(bare.world, stood))
    read = survey(hall, seed, options.heights, options.noise, options.survey_readings)
    seen = bare.cloud(), floor_cloud(bare)
    cloud = np.concatenate([*seen, *(surface(options, at) for at in inside.positions[standing])])
    learnt = build_map(read.points, read.field, options.map, cloud)
    span = min(options.heights), max(options.heights)
    return LoadedHall(
        hall,
        seed,
        for_solvers(learnt),
        calibration_drive(hall, seed, span, options.noise, options.sensors, 30).sensors,
        tuple(five_changes(options, inside, *STEPS[path], rng) for path in range(options.paths)),
    )


def five_changes(
    options: ChangesStudyOptions,
    loads: Loads,
    comes: int,
    goes: int,
    moves: int,
    rng: np.random.Generator,
) -> Loads:
    """Return five sources: a load that comes, one that goes, one that moves out, one outside."""
    out = np.array([outside(options, rng) for _ in range(2)])
    m = loads.moments
    moments = [m[comes], -m[goes], -m[moves], m[moves], *drawn(options, 1, rng)]
    return Loads(np.concatenate([loads.positions[[comes, goes, moves]], out]), np.array(moments))


def floor_cloud(hall: SteelHall) -> FloatArray:
    """Return what a LiDAR sees of the floor of the area and around, metres, shape (P, 3).

    Without it a map takes the lowest that it knows of for floor: a load half a metre high beside
    readings at 0.4 m, which is then no structure.
    """
    x, y = (np.arange(-half, half + FLOOR_M / 2, FLOOR_M) for half in HALF_AREA + AROUND_M)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.column_stack([xy, hall.floor.height(xy)])


def surface(options: ChangesStudyOptions, position: FloatArray) -> FloatArray:
    """Return what a LiDAR sees of a load, metres, shape (P, 3)."""
    edges = np.array(options.edges)
    box = Boxes(("load",), edges[None], position[None], np.zeros(1), np.zeros(1))
    return SteelStructure(box, position[:2], edges[:2] / 2).cloud()


def drawn(options: ChangesStudyOptions, count: int, rng: np.random.Generator) -> FloatArray:
    """Return moments of any direction, in A m^2, their logarithms evenly spread, (count, 3)."""
    low, high = options.moment
    size = np.exp(rng.uniform(np.log(low), np.log(high), count))
    return np.array([each * direction(rng) for each in size])


def outside(options: ChangesStudyOptions, rng: np.random.Generator) -> FloatArray:
    """Return a place beyond the border of the area, metres, shape (3,)."""
    along, side = rng.integers(2), rng.choice([-1.0, 1.0])
    place: FloatArray = rng.uniform(-1, 1, 3) * np.append(HALF_AREA, 0.0)
    place[along] = side * (HALF_AREA[along] + rng.uniform(*options.beyond))
    place[2] = rng.uniform(*options.heights_of_steel)
    return place


def joined(world: SteelWorld, other: SteelWorld) -> SteelWorld:
    """Return a world with the bodies of another, in the field of the first."""
    whole = joined_rows([world, other])
    return replace(whole, kinds=world.kinds + other.kinds, earth=world.earth)

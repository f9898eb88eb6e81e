"""Rounds of changes on one hall: the map that is kept up beside a fresh survey."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.changed_places import ChangesOptions
from l2m_gtsam.data import FloatArray, KnownSensor, Recording, Trajectory
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.maps.field_map import FieldMap
from l2m_gtsam.simulate.hall_drives import (
    LANE_M,
    calibration_drive,
    driven,
    survey,
)
from l2m_gtsam.simulate.steel_hall import (
    HALF_AREA,
    SteelHall,
    steel_hall,
)
from l2m_gtsam.studies.changes.loads import (
    ChangesStudyOptions,
    Loads,
    drawn,
    joined,
    outside,
    surface,
)
from l2m_gtsam.studies.validation.drives import NO_STEEL, HallPath, direction, recorded
from l2m_gtsam.upkeep.kept_map import kept_up

FIRST_NS, DAY_NS = 1_700_000_000 * 10**9, 86_400 * 10**9
OUTSIDE = 8  # places for loads beyond the area, besides those on timber
STANDING = 3  # of so many places one has a load when the hall is surveyed
MOST_EVENTS = 3  # of a round
JUDGED_HEIGHTS, JUDGED = (0.45, 0.6, 0.8, 0.95), 400  # between the survey's; places at each
STEP_M = 0.1  # from pose to pose
FRESH = 500  # a survey's seed over that of the hall


@dataclass(frozen=True)
class MapScore:
    """How far off a map is.

    Attributes
    ----------
    rms
        Of the field per axis in uT.
    z
        Root mean square of its errors over what the map states for them.
    """

    rms: float
    z: float


@dataclass(frozen=True)
class RoundsEnd:
    """Errors after the last round: of the first survey, of the kept map, of a fresh survey."""

    first: MapScore
    kept: MapScore
    fresh: MapScore
    field_map: FieldMap


class Warehouse:
    """A hall whose loads come, go and are moved.

    Parameters
    ----------
    options, seed
        Of the study; the seed of the hall and of all that is random in it.
    """

    def __init__(self, options: ChangesStudyOptions, seed: int) -> None:
        self.options, self.seed = options, seed
        self.rng, self.bare = np.random.default_rng([seed, 77]), steel_hall(seed)
        timber = np.array([each.centre for each in self.bare.timber])
        height = self.rng.uniform(*options.heights_of_steel, len(timber))
        beyond = [outside(options, self.rng) for _ in range(OUTSIDE)]
        self.places: FloatArray = np.vstack([np.column_stack([timber, height]), *beyond])
        first = self.rng.permutation(len(self.places))[: len(self.places) // STANDING]
        self.loads = {int(k): drawn(options, 1, self.rng)[0] for k in first}

    def change(self) -> None:
        """Let one to three loads come, go or be moved."""
        for _ in range(int(self.rng.integers(1, MOST_EVENTS + 1))):
            free = [k for k in range(len(self.places)) if k not in self.loads]
            what = int(self.rng.integers(3)) if self.loads else 0
            if what == 0:
                self.loads[int(self.rng.choice(free))] = drawn(self.options, 1, self.rng)[0]
                continue
            moment = self.loads.pop(int(self.rng.choice(sorted(self.loads))))
            if what == 1:
                turned = float(np.linalg.norm(moment)) * direction(self.rng)
                self.loads[int(self.rng.choice(free))] = turned

    @property
    def hall(self) -> SteelHall:
        """The hall with the loads that stand there."""
        at = sorted(self.loads)
        if not at:
            return self.bare
        loads = Loads(self.places[at], np.array([self.loads[k] for k in at]))
        return replace(self.bare, world=joined(self.bare.world, loads.steel(self.options)))

    def surveyed(self, seed: int) -> FieldMap:
        """Return the map of a survey, with what a LiDAR sees."""
        o = self.options
        read = survey(self.hall, seed, o.heights, o.noise, o.survey_readings)
        seen = self.bare.cloud()
        loads = [surface(o, self.places[k]) for k in sorted(self.loads)]
        return build_map(read.points, read.field, o.map, np.concatenate([seen, *loads]))

    def driven(self, sensors: tuple[KnownSensor, ...], number: int) -> Recording:
        """Return what a vehicle records that goes through the whole hall on a day."""
        seed = 1000 * self.seed + number
        path = HallPath(patrol(self.bare, seed), seed)
        recording = recorded(self.options, self.hall, path, sensors, NO_STEEL)
        poses, late = recording.trajectory, FIRST_NS + number * DAY_NS
        return replace(
            recording,
            trajectory=replace(poses, stamp_ns=poses.stamp_ns + late),
            series=tuple(replace(each, stamp_ns=each.stamp_ns + late) for each in recording.series),
        )

    def errors_of(self, field_map: FieldMap) -> MapScore:
        """Return how far off a map is where sensors come, at heights that no survey had."""
        hall, noise = self.hall, self.options.noise
        points = np.concatenate(
            [
                survey(hall, 9000 + self.seed + k, (z,), noise, JUDGED).points
                for k, z in enumerate(JUDGED_HEIGHTS)
            ]
        )
        known = field_map.query(points)
        e = (known.field - hall.world.field(points))[known.inside]
        z = e / np.sqrt(known.variance[known.inside])
        return MapScore(float(np.sqrt(np.mean(e**2))), float(np.sqrt(np.mean(z**2))))


def patrol(hall: SteelHall, seed: int) -> Trajectory:
    """Return poses of a vehicle that goes through the whole area in lanes, there and back.

    Random is along which axis, and where the lanes lie.
    """
    rng = np.random.default_rng([seed, 7])
    along = int(rng.integers(2))
    reach = HALF_AREA - 0.1
    across = np.arange(-reach[1 - along] + rng.uniform(0, LANE_M / 2), reach[1 - along], LANE_M)
    s = np.linspace(-reach[along], reach[along], round(2 * reach[along] / STEP_M))
    curve = np.empty((len(across), len(s), 2))
    curve[:, :, along] = s
    curve[1::2, :, along] = s[::-1]
    curve[:, :, 1 - along] = across[:, None]
    return driven(hall, curve.reshape(-1, 2))


def rounds_end(options: ChangesStudyOptions, seed: int, rounds: int) -> RoundsEnd:
    """Return how a map ends that is kept up through rounds of changes, one drive in each."""
    place = Warehouse(options, seed)
    first = kept = place.surveyed(seed)
    span = min(options.heights), max(options.heights)
    sensors = calibration_drive(place.bare, seed, span, options.noise, options.sensors, 30).sensors
    suite = {each.sensor: each for each in sensors}
    for number in range(1, rounds + 1):
        place.change()
        drive = place.driven(sensors, number)
        kept = kept_up(kept, [drive], suite, MappingOptions(), ChangesOptions())
    fresh = place.surveyed(seed + FRESH)
    errors = [place.errors_of(each) for each in (first, kept, fresh)]
    return RoundsEnd(errors[0], errors[1], errors[2], kept)

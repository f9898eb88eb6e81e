"""Surveys of a place by a suite that is, or is not, what its file says."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import QueryableMap, for_solvers
from l2m_gtsam.data import (
    Distortion,
    FieldSeries,
    FloatArray,
    IntArray,
    KnownSensor,
    Recording,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.mapping.map_building import map_recordings
from l2m_gtsam.mapping.options import MappingOptions
from l2m_gtsam.simulate.hall_drives import (
    LIDAR_M,
    STEP_NS,
    CalibrationDrive,
    calibration_drive,
    survey,
)
from l2m_gtsam.simulate.office_corridor import OfficeCorridor, office_corridor
from l2m_gtsam.simulate.office_drives import office_drive, survey_way
from l2m_gtsam.simulate.steel_hall import SteelHall, steel_hall
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions, World

SENSORS = 2


@dataclass(frozen=True)
class Place:
    """A place of which everything is known, and its seed."""

    built: SteelHall | OfficeCorridor
    seed: int

    def survey_way(self, options: TroublesOptions) -> FloatArray:
        """Return lanes over the floor of a hall, or to and fro in a corridor."""
        if isinstance(self.built, OfficeCorridor):
            return survey_way(self.built, self.seed, options.heights, options.survey_readings)
        chosen = options.heights, options.noise, options.survey_readings
        return survey(self.built, self.seed, *chosen).points

    def drive(self, options: TroublesOptions, seed: int) -> CalibrationDrive:
        """Return a drive round posts and racks, or to and fro."""
        span = (min(options.heights), max(options.heights))
        chosen = seed, span, options.noise, SENSORS, options.readings
        if isinstance(self.built, OfficeCorridor):
            return office_drive(self.built, *chosen)
        return calibration_drive(self.built, *chosen)


def place_of(world: World, seed: int) -> Place:
    """Return a place of a kind by its seed."""
    return Place(steel_hall(seed) if world is World.HALL else office_corridor(seed), seed)


ASIDE_M = 0.25  # of the suite's sensors from the middle of the vehicle


@dataclass(frozen=True)
class TroubledPlace:
    """A place and the map of its survey under one condition."""

    truth: Place
    field_map: QueryableMap


def troubled_place(
    options: TroublesOptions, world: World, trouble: Trouble, number: int
) -> TroubledPlace:
    """Return a place of a kind by its number, surveyed as a condition has it."""
    truth = place_of(world, options.seed + number)
    read = survey_of(truth, options)
    suite = known_suite(options)
    recording = read.recorded(suite, truth, options, off=trouble.wrong_suite)
    if trouble is not Trouble.SUITE_STATED:
        suite = {name: replace(each, covariance=None) for name, each in suite.items()}
    chosen = MappingOptions(model=options.map)
    learnt = map_recordings([recording], suite, chosen, truth.built.cloud())
    return TroubledPlace(truth, for_solvers(learnt))


@dataclass(frozen=True)
class SurveyDrive:
    """Poses of the lidar at the readings of a suite, a sensor for each height.

    Attributes
    ----------
    seed
        Of the survey.
    sensor
        Which sensor reads at each pose, shape (N,).
    R, p
        The poses, shapes (N, 3, 3) and (N, 3).
    noise
        Of the readings in uT.
    """

    seed: int
    sensor: IntArray
    R: FloatArray
    p: FloatArray
    noise: float

    def recorded(
        self, suite: dict[str, KnownSensor], truth: Place, options: TroublesOptions, *, off: bool
    ) -> Recording:
        """Return what a suite reads; the vehicle's clocks are right.

        ``off`` is whether its sensors are not as known, by draws of the options' sigmas.
        """
        rng, count = np.random.default_rng([self.seed, 11]), len(self.p)
        draws = rng.standard_normal((len(suite), 16)) * options.suite_sigmas
        noise, stamps = self.noise * rng.standard_normal((count, 3)), np.arange(count) * STEP_NS
        series = []
        for index, (known, draw) in enumerate(zip(suite.values(), draws, strict=True)):
            true, own = _off(known, draw) if off else known, self.sensor == index
            B = truth.built.field(self.R[own] @ true.t_lidar_mag + self.p[own])
            field = true.distortion.apply(np.einsum("nji,nj->ni", self.R[own], B)) + noise[own]
            name = known.sensor
            series.append(FieldSeries(name, f"/{name}", name, stamps[own], field))
        trajectory = Trajectory(stamps, self.R, self.p, "map", "lidar")
        return Recording(trajectory, tuple(series), SourceFile(f"survey-{self.seed}", ""))


def survey_of(truth: Place, options: TroublesOptions) -> SurveyDrive:
    """Return the poses of a survey: every sensor of the suite goes over the whole floor."""
    points = truth.survey_way(options)
    # A lane's direction is that to the next point; the first and last of a lane turn.
    ahead = np.gradient(points[:, :2], axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    R = Rotation.from_euler("Z", yaw[:, None]).as_matrix()
    height = np.array(options.heights)
    floor = truth.built.height(points[:, :2])
    sensor = np.abs((points[:, 2] - floor)[:, None] - height).argmin(axis=1)
    t = np.stack([each.t_lidar_mag for each in known_suite(options).values()])[sensor]
    return SurveyDrive(truth.seed, sensor, R, points - np.einsum("nij,nj->ni", R, t), options.noise)


def known_suite(options: TroublesOptions) -> dict[str, KnownSensor]:
    """Return the suite as its file has it, with sigmas: sensors one above the other."""
    covariance = np.diag(options.suite_sigmas**2)
    sensors = [
        KnownSensor(
            f"suite_{index}",
            np.array([0.0, ASIDE_M * (index - 1), height - LIDAR_M]),
            Distortion.identity(),
            covariance=covariance,
        )
        for index, height in enumerate(options.heights)
    ]
    return {each.sensor: each for each in sensors}


def _off(sensor: KnownSensor, error: FloatArray) -> KnownSensor:
    """Return the sensor as it is where what is known of it is wrong by an error, shape (16,)."""
    distortion = Distortion.from_vector(sensor.distortion.vector() + error[3:15])
    return replace(sensor, t_lidar_mag=sensor.t_lidar_mag + error[:3], distortion=distortion)

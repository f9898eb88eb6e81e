"""Surveys of a hall by a suite that is, or is not, what its file says."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import Compilable, QueryableMap
from l2m_gtsam.data import Distortion, FloatArray, IntArray, KnownSensor, LidarMotion, Readings
from l2m_gtsam.mapping.map_building import map_fields, sensor_positions
from l2m_gtsam.mapping.suite_shifts import suite_errors
from l2m_gtsam.maps.build import build_map
from l2m_gtsam.simulate.hall_drives import LIDAR_M, STEP_NS, survey
from l2m_gtsam.simulate.steel_hall import CloudVariant, SteelHall, hall_cloud, steel_hall
from l2m_gtsam.studies.troubles.options import Trouble, TroublesOptions

ASIDE_M = 0.25  # of the suite's sensors from the middle of the vehicle


@dataclass(frozen=True)
class TroubledHall:
    """A hall and the map of its survey under one condition."""

    hall: SteelHall
    seed: int
    field_map: QueryableMap


def troubled_hall(options: TroublesOptions, trouble: Trouble, number: int) -> TroubledHall:
    """Return a hall by its number, surveyed as a condition has it."""
    seed = options.seed + number
    hall = steel_hall(seed)
    read = survey_of(hall, seed, options)
    suite = known_suite(options)
    points, field = read.given(suite, hall, options, off=trouble.wrong_suite)
    stated = suite_errors(read.readings(field), suite) if trouble is Trouble.SUITE_STATED else None
    mapped = map_fields(read.readings(field), suite)
    cloud = hall_cloud(hall, CloudVariant.ACCURATE, seed)
    learnt = build_map(points, mapped, options.map, cloud, stated)
    compiled = learnt.compile() if isinstance(learnt, Compilable) else learnt
    return TroubledHall(hall, seed, compiled)


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

    def given(
        self, suite: list[KnownSensor], hall: SteelHall, options: TroublesOptions, *, off: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return where a suite is thought to read, and what it reads, shapes (N, 3).

        ``off`` is whether its sensors are not as known, by draws of the options' sigmas.
        """
        rng = np.random.default_rng([self.seed, 11])
        draws = rng.standard_normal((len(suite), 16)) * options.suite_sigmas
        noise = self.noise * rng.standard_normal(self.p.shape)
        truth = [_off(s, draw) if off else s for s, draw in zip(suite, draws, strict=True)]
        field = np.empty_like(self.p)
        for index, sensor in enumerate(truth):
            own = self.sensor == index
            B = hall.world.field(self.R[own] @ sensor.t_lidar_mag + self.p[own])
            field[own] = sensor.distortion.apply(np.einsum("nji,nj->ni", self.R[own], B))
        readings = self.readings(field)
        return sensor_positions(readings, suite), field + noise

    def readings(self, field: FloatArray) -> Readings:
        """Return what was read, with poses; the vehicle's clocks are right."""
        count = len(self.p)
        still = LidarMotion(np.zeros((count, 6)), np.zeros(count))
        names = tuple(f"suite_{index}" for index in range(int(self.sensor.max()) + 1))
        stamps = np.arange(count) * STEP_NS
        return Readings(names, self.sensor, stamps, self.R, self.p, field, motion=still)


def survey_of(hall: SteelHall, seed: int, options: TroublesOptions) -> SurveyDrive:
    """Return the poses of a survey: every sensor of the suite goes over the whole floor."""
    points = survey(hall, seed, options.heights, options.noise, options.survey_readings).points
    # A lane's direction is that to the next point; the first and last of a lane turn.
    ahead = np.gradient(points[:, :2], axis=0)
    yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
    R = Rotation.from_euler("Z", yaw[:, None]).as_matrix()
    height = np.array(options.heights)
    floor = hall.floor.height(points[:, :2])
    sensor = np.abs((points[:, 2] - floor)[:, None] - height).argmin(axis=1)
    t = np.stack([each.t_lidar_mag for each in known_suite(options)])[sensor]
    return SurveyDrive(seed, sensor, R, points - np.einsum("nij,nj->ni", R, t), options.noise)


def known_suite(options: TroublesOptions) -> list[KnownSensor]:
    """Return the suite as its file has it, with sigmas: sensors one above the other."""
    covariance = np.diag(options.suite_sigmas**2)
    return [
        KnownSensor(
            f"suite_{index}",
            np.array([0.0, ASIDE_M * (index - 1), height - LIDAR_M]),
            Distortion.identity(),
            covariance=covariance,
        )
        for index, height in enumerate(options.heights)
    ]


def _off(sensor: KnownSensor, error: FloatArray) -> KnownSensor:
    """Return the sensor as it is where what is known of it is wrong by an error, shape (16,)."""
    distortion = Distortion.from_vector(sensor.distortion.vector() + error[3:15])
    return replace(sensor, t_lidar_mag=sensor.t_lidar_mag + error[:3], distortion=distortion)

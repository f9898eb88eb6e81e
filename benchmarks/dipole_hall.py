"""A hall of dipoles that several benchmarks drive through: its survey, its map and its sensors."""

from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.alternation import OneKeyOptions, start_estimate
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.data import KnownSensor
from l2m_gtsam.maps.harmonic.harmonic_map import CompiledMap, HarmonicMap
from l2m_gtsam.maps.training import TrainingSet, checked_readings
from tests.worlds.exact import DipoleWorld

NOISE = 0.1  # uT, of the survey and of the sensors


def hall(seed: int) -> DipoleWorld:
    """Return a hall with steel 1.5 m under its floor and 3 m above it: a few uT, well mapped."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform([-8, -8, 0], [8, 8, 0], (60, 3))
    positions[:, 2] = np.where(np.arange(60) % 2 == 0, -1.5, 3.0)
    return DipoleWorld(np.array([22.0, 3.0, -38.0]), positions, rng.normal(0, 120, (60, 3)))


def survey(world: DipoleWorld, count: int) -> TrainingSet:
    """Return readings in the volume that the drives of the benchmark pass."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-5.5, -5.5, -0.6], [5.5, 5.5, 1.6], (count, 3))
    field, _ = world.field_and_gradient(points)
    return checked_readings(points, field + rng.normal(0, NOISE, field.shape))


def compiled_map(world: DipoleWorld) -> CompiledMap:
    """Return the harmonic map of a survey, compiled."""
    data = survey(world, 8000)
    return HarmonicMap.fit(data.points, data.field).compile()


def true_start(sensors: tuple[KnownSensor, ...], options: OneKeyOptions) -> Estimate:
    """Return an estimate that is the truth."""
    start = start_estimate(np.stack([s.t_lidar_mag for s in sensors]), options)
    truth = np.stack([s.distortion.vector() for s in sensors])
    return replace(start, distortion=truth, noise=np.full(len(sensors), NOISE))

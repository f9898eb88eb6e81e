"""Laps past a pallet of steel that is moved when half of them are driven."""

from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.data import FloatArray, KnownSensor
from tests.drives.slam import SlamDrive, laps, slam_drive
from tests.worlds.exact import DipoleWorld, dipole_world, random_sensors

FOUR_LAPS = 140  # seconds of laps of 21 m
PALLET = 100.0  # A m2, spread over 0.9 x 0.5 m, 1.3 m beside the way
SENSORS = 2


@dataclass(frozen=True)
class MovedSteel:
    """One drive twice: where the pallet stays, and where it is moved after the second lap."""

    sensors: tuple[KnownSensor, ...]
    still: SlamDrive
    moved: SlamDrive


def moved_steel(seed: int) -> MovedSteel:
    """Return drives through a hall; the pallet is moved by 0.7 to 1.4 rad of the way."""
    sensors, hall, truth = random_sensors(seed, SENSORS), dipole_world(seed), laps(FOUR_LAPS)
    rng = np.random.default_rng([seed, 5])
    first = rng.uniform(0, 2 * np.pi)
    then = first + rng.uniform(0.7, 1.4)
    moment = rng.normal(size=3)
    moment *= PALLET / np.linalg.norm(moment)
    still, after = (
        slam_drive(with_pallet(hall, at, moment), sensors, truth, np.random.default_rng(seed))
        for at in (first, then)
    )
    half = truth.stamp_ns[len(truth) // 2]
    series = tuple(
        replace(a, field=np.where((a.stamp_ns < half)[:, None], a.field, b.field))
        for a, b in zip(still.recording.series, after.recording.series, strict=True)
    )
    moved = replace(still, recording=replace(still.recording, series=series))
    return MovedSteel(sensors, still, moved)


def with_pallet(hall: DipoleWorld, angle: float, moment: FloatArray) -> DipoleWorld:
    """Return a hall with a pallet outside of the laps, in four by three pieces."""
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, 4), np.linspace(-0.25, 0.25, 3))
    middle = np.array([5.3 * np.cos(angle), 3.8 * np.sin(angle), 0.4])
    pieces = middle + np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    moments = np.tile(moment / len(pieces), (len(pieces), 1))
    return hall.with_dipoles(pieces, moments)

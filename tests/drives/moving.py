"""Drives of a vehicle whose motor adds a field of its own, over a map that knows its errors."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import (
    FieldSeries,
    FloatArray,
    KnownSensor,
    Recording,
    ScalarSeries,
    SourceFile,
    Trajectory,
)
from l2m_gtsam.records.calibration import Uncertainty
from tests.drives.uncertain import NOISE, WORLD, small_sensors
from tests.worlds.exact import exact_reading

STEP_NS, START_NS = 50_000_000, 1_700_000_000_000_000_000


@dataclass(frozen=True)
class MovingDrive:
    """A recording with a motor's current, and what is true.

    Attributes
    ----------
    recording
        With one number, `motor`.
    sensors
        The truth.
    h
        The motor's field in uT per ampere, sensor by sensor, shape (S, 3).
    """

    recording: Recording
    sensors: tuple[KnownSensor, ...]
    h: FloatArray

    @property
    def silent(self) -> Recording:
        """The same without the number."""
        return replace(self.recording, scalars=())

    def error(self, sensor: int, found: FloatArray) -> FloatArray:
        """Return the error of (t, C row by row, H), shape (15,)."""
        known = self.sensors[sensor]
        return np.asarray(found - known.vector())


def current(seed: int, seconds: FloatArray) -> FloatArray:
    """Return a motor's current in A that swings slowly about 5 A, shape (N,)."""
    rng = np.random.default_rng([seed, 2])
    swing = 3 * np.sin(2 * np.pi * rng.uniform(0.05, 0.15) * seconds + rng.uniform(0, 6))
    return np.asarray(5 + swing + rng.normal(0, 0.5, len(seconds)))


def moving_drive(
    seed: int, strengths: tuple[float, ...], amperes: FloatArray | None = None, count: int = 500
) -> MovingDrive:
    """Return a smooth drive of 25 s that turns, tilts and heaves.

    Parameters
    ----------
    seed
        Of everything.
    strengths
        How much each sensor feels of the motor in uT/A.
    amperes
        The motor's current, shape (N,).
    count
        Number N of readings of each sensor.
    """
    rng = np.random.default_rng([seed, 1])
    seconds: FloatArray = np.arange(count, dtype=float) * (STEP_NS * 1e-9)
    amperes = current(seed, seconds) if amperes is None else amperes
    trajectory = _trajectory(rng, seconds)
    small = small_sensors(len(strengths), seed)
    h = rng.normal(size=(len(strengths), 3))
    h *= np.array(strengths)[:, None] / np.linalg.norm(h, axis=1)[:, None]
    series = tuple(
        _series(rng, trajectory, sensor, np.outer(amperes, each))
        for sensor, each in zip(small, h, strict=True)
    )
    motor = ScalarSeries("motor", "/motor", trajectory.stamp_ns, amperes)
    return MovingDrive(
        Recording(trajectory, series, SourceFile("drive.bag", "ab12"), (motor,)), small, h
    )


def options(
    drive: MovingDrive, kind: Uncertainty = Uncertainty.FULL, *, steel: bool = True
) -> CalibrationOptions:
    """Return options that start each sensor 9 cm from its place.

    ``steel`` is whether steel is looked for that came or went since the survey.
    """
    start = {each.sensor: tuple((each.t_lidar_mag + 0.05).tolist()) for each in drive.sensors}
    changes = {} if steel else {"sources": {"most": 0}}
    return CalibrationOptions.model_validate(
        {"start": start, "solve": OneKeyOptions(uncertainty=kind), "changes": changes}
    )


def _trajectory(rng: np.random.Generator, s: FloatArray) -> Trajectory:
    a = rng.uniform(0, 2 * np.pi, 6)
    angles = np.column_stack(
        [0.5 * s + a[0], 0.2 * np.sin(1.1 * s + a[1]), 0.2 * np.cos(1.7 * s + a[2])]
    )
    p = np.column_stack(
        [
            1.1 * np.sin(0.3 * s + a[3]),
            1.1 * np.sin(0.43 * s + a[4]),
            0.5 + 0.1 * np.sin(0.9 * s + a[5]),
        ]
    )
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    return Trajectory(START_NS + np.arange(len(s)) * STEP_NS, R, p, "map", "lidar")


def _series(
    rng: np.random.Generator, path: Trajectory, sensor: KnownSensor, more: FloatArray
) -> FieldSeries:
    field = exact_reading(WORLD, sensor, path.R, path.p) + more
    field += NOISE * rng.normal(size=field.shape)
    return FieldSeries(sensor.sensor, "/" + sensor.sensor, "mag", path.stamp_ns, field)

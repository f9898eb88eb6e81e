"""Readings of simulated drives whose model is known."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.records.sensor_models import Coefficients, Model, Samples

STEP = 0.1  # seconds between readings
NOISE = 0.2  # uT
EARLY = 500  # values that are drawn before the first reading, to forget where they began


@dataclass(frozen=True)
class Setting:
    """What is drawn.

    Attributes
    ----------
    readings
        Number of them.
    noise
        Of the sensor in uT.
    map_error
        Of the map in uT, as the sensor sees it.
    length
        Readings over which the map's errors forget themselves.
    """

    readings: int = 400
    noise: float = NOISE
    map_error: float = 0.0
    length: float = 10.0


@dataclass(frozen=True)
class Drawn:
    """Readings and what they are made of."""

    samples: Samples
    truth: Coefficients


def times(readings: int) -> FloatArray:
    """Seconds of so many readings, shape (N,)."""
    return np.arange(readings, dtype=float) * STEP


def field(t: FloatArray, seed: int) -> FloatArray:
    """The field in the lidar frame in uT of a vehicle that turns, tilts a little and passes steel.

    Parameters
    ----------
    t
        Seconds, shape (N,).
    seed
        Of the drive.
    """
    rng = np.random.default_rng(seed)
    phase, rate = rng.uniform(0, 2 * np.pi, (4, 3)), rng.uniform(0.05, 0.4, (4, 3))
    waves = np.sin(2 * np.pi * rate * t[:, None, None] + phase)
    in_map = np.array([20.0, 0.0, -42.0]) + 6 * waves.sum(axis=1)
    heading = 0.6 * t + 1.2 * np.sin(0.2 * t + phase[0, 0])
    tilt = 0.06 * np.sin(1.3 * t + phase[0, 1])
    R = Rotation.from_euler("ZY", np.column_stack([heading, tilt])).as_matrix()
    return np.asarray(np.einsum("nji,nj->ni", R, in_map))


def current(t: FloatArray, seed: int) -> FloatArray:
    """A motor's current in A that swings slowly about 5 A, shape (N, 1)."""
    rng = np.random.default_rng(seed + 1)
    swing = 2 * np.sin(2 * np.pi * rng.uniform(0.05, 0.3) * t + rng.uniform(0, 2 * np.pi))
    return np.asarray(5 + swing + rng.normal(0, 0.3, len(t)))[:, None]


def coefficients(model: Model, seed: int) -> Coefficients:
    """What multiplies what: effects of 1 to 2 uT in every term that a model has."""
    rng = np.random.default_rng(seed + 2)
    C = Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix()
    scale, rest = rng.choice([-0.05, 0.05], 3), rng.choice([-0.03, 0.03], (3, 3))
    if model is not Model.OFFSET:
        C = (1 + scale)[:, None] * C
    if model not in (Model.OFFSET, Model.SCALE):
        C = C + rest
    h = rng.choice([-0.3, 0.3], (1, 3)) * model.has_regressors
    E = rng.choice([-0.02, 0.02], (3, 3)) * model.has_eddy
    return Coefficients(C, rng.normal(0, 20, 3), h, E)


def drawn(model: Model, seed: int, setting: Setting | None = None) -> Drawn:
    """Readings of a drive for which a model is the truth."""
    setting = Setting() if setting is None else setting
    rng = np.random.default_rng(seed + 3)
    t = times(setting.readings)
    tiny = 1e-3  # seconds, either way
    db_dt = (field(t + tiny, seed) - field(t - tiny, seed)) / (2 * tiny)
    fade = np.exp(-1 / setting.length)
    drops = rng.normal(0, np.sqrt(1 - fade**2), (EARLY + len(t), 3))
    error = setting.map_error * lfilter([1.0], [1.0, -fade], drops, axis=0)[EARLY:]
    truth = coefficients(model, seed)
    weights = np.full(len(t), 1 / (setting.noise**2 + setting.map_error**2))
    none = Samples(
        np.zeros((len(t), 3)), field(t, seed), db_dt, current(t, seed), weights, ("amp",)
    )
    z = error + rng.normal(0, setting.noise, error.shape) - truth.residual(none)
    return Drawn(Samples(z, none.b, none.db_dt, none.q, weights, none.names), truth)

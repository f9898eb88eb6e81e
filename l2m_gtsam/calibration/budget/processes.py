r"""Processes that a drive may have beside noise: wander of H, errors of poses, a warped frame.

Each is a sum of modes with independent weights, whose variances follow a spectrum. Over the time of
a drive, u from 0 to 1, the modes are :math:`\sqrt 2 \cos j \pi u`. They are those of a random walk
about its mean (variances :math:`1 / (j \pi)^2`, the Karhunen-Loeve series of Brownian motion), and
near enough those of 1/f noise (1/j) and of errors that last for a time tau (Ornstein-Uhlenbeck:
:math:`2 \tau / T / (1 + (j \pi \tau / T)^2)`). Over a floor they are products of such cosines, with
the spectrum of a field that is smooth over a length (Solin and Sarkka, Statistics and Computing 30,
2020).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from l2m_factors import DifferentiableMap, PoseMotion, moved
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.pose_errors import pose_features
from l2m_gtsam.calibration.view import QueryableMap, places_of
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.records.error_budget import DisturbanceKind
from l2m_gtsam.solve.linear_algebra import right_divided

WANDER_MODES = 24  # slower ones hold all but 2 % of a walk; faster ones of 1/f noise are noise
LASTING_S = (1.0, 2.0, 4.0, 8.0)  # how long errors of poses may last
POSE_PARTS = {  # of rotation and translation along the axes of the lidar
    "tilt": (1, 1, 0, 0, 0, 0),
    "heading": (0, 0, 1, 0, 0, 0),
    "floor": (0, 0, 0, 1, 1, 0),
    "height": (0, 0, 0, 0, 0, 1),
}
WARP_M = (3.0, 8.0)  # lengths over which a frame may be bent
BEND_S = 0.1  # to either side; a filter of 50 ms has weight so far
BEYOND_M = 8.0  # cosines are level at their ends: these lie as far outside as bends are long
FAINT = 0.01  # of the largest variance of a mode: what less have is left out


@dataclass(frozen=True)
class ReadingPlaces:
    """What N readings are taken at, by an estimate.

    Attributes
    ----------
    readings
        Themselves.
    t
        Of their sensors in metres, shape (N, 3).
    C
        Of their sensors, shape (N, 3, 3).
    x
        Where in the map, metres, shape (N, 3).
    b_lidar
        Field in the lidar frame in uT, shape (N, 3).
    slope
        How it grows along the axes of the map, ``R^T G`` in uT/m, shape (N, 3, 3).
    bend
        Its second derivative along the drive in uT/s^2, lidar frame, shape (N, 3); absent where it
        is not known how the lidar moves.
    """

    readings: Readings
    t: FloatArray
    C: FloatArray
    x: FloatArray
    b_lidar: FloatArray
    slope: FloatArray
    bend: FloatArray | None = None

    @classmethod
    def of(cls, readings: Readings, field_map: QueryableMap, estimate: Estimate) -> "ReadingPlaces":
        """Return what a map says where an estimate puts readings."""
        x = places_of(readings, estimate.t)
        field, gradient = field_map.field_and_gradient(x)
        R_lidar_map = readings.R_map_lidar.transpose(0, 2, 1)
        b_lidar = np.einsum("nij,nj->ni", R_lidar_map, field)
        t, C = estimate.t[readings.sensor], estimate.C()[readings.sensor]
        bend = field_bend(readings, field_map, t, b_lidar)
        return cls(readings, t, C, x, b_lidar, R_lidar_map @ gradient, bend)

    def pose_features(self, rows: IntArray) -> FloatArray:
        """Return what a unit of each error of poses does to the field, lidar frame, (n, 3, 6)."""
        unit = np.broadcast_to(np.eye(6), (len(rows), 6, 6))
        slope = self.slope[rows] @ self.readings.R_map_lidar[rows]
        return pose_features(unit, self.b_lidar[rows], slope, self.t[rows])


def field_bend(
    readings: Readings, field_map: DifferentiableMap, t: FloatArray, b_lidar: FloatArray
) -> FloatArray | None:
    """Return the second derivative of the field along a drive in uT/s^2, lidar frame, (N, 3).

    Parameters
    ----------
    readings
        N of them; of ``None`` there is none where they do not say how the lidar moves.
    field_map
        What is asked a moment before and after each; where it knows nothing the field is straight.
    t
        Of their sensors in the lidar frame in metres, shape (N, 3).
    b_lidar
        Field at the readings in the lidar frame in uT, shape (N, 3).
    """
    if readings.motion is None:
        return None
    bend = -2 * b_lidar
    for step in (-BEND_S, BEND_S):
        twist = readings.motion.twist_lidar + 0.5 * step * readings.motion.acceleration_lidar
        motion = PoseMotion(twist, np.zeros(len(t)))
        R, p = moved(readings.R_map_lidar, readings.p_map_lidar, motion, np.full(len(t), step))
        field, _ = field_map.field_and_gradient(p + np.einsum("nij,nj->ni", R, t))
        bend += np.einsum("nji,nj->ni", R, field)
    return np.asarray(np.nan_to_num(bend / BEND_S**2))


@dataclass(frozen=True)
class Process(ABC):
    """A process by its modes.

    Attributes
    ----------
    places
        Readings that it may be in.
    sensor
        Whose they are; all if none is named.
    kind
        What it is.
    """

    places: ReadingPlaces
    sensor: int | None
    kind: ClassVar[DisturbanceKind]

    @property
    @abstractmethod
    def forms(self) -> tuple[FloatArray, ...]:
        """Alternatives: each the variances of m weights by K parts of a unit size, shape (K, m)."""

    @abstractmethod
    def features(self, rows: IntArray) -> FloatArray:
        """Return what weights do to the field in uT, lidar frame, shape (n, 3, m)."""

    @abstractmethod
    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return the standard deviations of a form by name and unit, for variances of its parts."""

    def on(self, places: ReadingPlaces) -> Self:
        """Return the same modes, weight by weight, in other readings."""
        return replace(self, places=places)


@dataclass(frozen=True)
class TimeModes:
    """Cosines over the time of each of D drives.

    Attributes
    ----------
    drives
        Their numbers, shape (D,).
    first_ns, last_ns
        When they began and ended, shapes (D,).
    count
        J, of each drive.
    """

    drives: IntArray
    first_ns: IntArray
    last_ns: IntArray
    count: int

    @classmethod
    def over(cls, readings: Readings, count: int) -> "TimeModes":
        """Return so many modes for each drive of some readings."""
        drives = np.unique(readings.of_drive)
        stamps = [readings.stamp_ns[readings.of_drive == each] for each in drives]
        first = np.array([each.min() for each in stamps])
        return cls(drives, first, np.array([each.max() for each in stamps]), count)

    @property
    def frequency(self) -> FloatArray:
        """J of each mode, shape (D J,)."""
        return np.tile(np.arange(1.0, self.count + 1), len(self.drives))

    @property
    def duration(self) -> FloatArray:
        """Of each mode's drive in seconds, shape (D J,)."""
        return np.repeat(self._lengths, self.count)

    @property
    def _lengths(self) -> FloatArray:
        return np.asarray(np.maximum(1e-9 * (self.last_ns - self.first_ns), 1e-9))

    def values(self, readings: Readings, rows: IntArray) -> FloatArray:
        """Return the modes at some of the readings, zero in other drives', shape (n, D J)."""
        drive, stamp = readings.of_drive[rows], readings.stamp_ns[rows]
        j, values = (
            np.arange(1, self.count + 1),
            np.zeros((len(rows), len(self.drives), self.count)),
        )
        for number, (each, length) in enumerate(zip(self.drives, self._lengths, strict=True)):
            own = np.flatnonzero(drive == each)
            u = 1e-9 * (stamp[own] - self.first_ns[number]) / length
            values[own, number] = np.sqrt(2) * np.cos(np.pi * j * u[:, None])
        return values.reshape(len(rows), len(self.drives) * self.count)


def lasting(modes: TimeModes, seconds: float) -> FloatArray:
    """Return the spectrum of errors of unit variance that last for a time, shape (D J,)."""
    share = seconds / modes.duration
    return np.asarray(2 * share / (1 + (np.pi * modes.frequency * share) ** 2))


def times_modes(features: FloatArray, modes: FloatArray) -> FloatArray:
    """Return what weights of J modes, (n, J), of a quantities do, (n, 3, a): shape (n, 3, J a)."""
    product = np.einsum("nia,nj->nija", features, modes)
    return np.asarray(product.reshape(len(features), 3, modes.shape[1] * features.shape[2]))


@dataclass(frozen=True)
class NoiseAndWalk(Process):
    """A field that has 1/f noise, a random walk, or both."""

    modes: TimeModes

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of 1/f noise and of a random walk together, uT^2."""
        j = np.repeat(self.modes.frequency, 3)
        return (np.stack([1 / j, 1 / (np.pi * j) ** 2]),)

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return noise and walk, uT."""
        whole = np.sum(1 / np.arange(1.0, self.modes.count + 1))
        noise, walk = np.sqrt(sizes * [whole, 1.0]).tolist()
        return {"noise_ut": noise, "walk_ut": walk}


@dataclass(frozen=True)
class Wander(NoiseAndWalk):
    """H of a sensor wanders."""

    sensor: int
    kind = DisturbanceKind.WANDER

    def features(self, rows: IntArray) -> FloatArray:
        """Return what adds to the readings along their axes, shape (n, 3, m)."""
        along = right_divided(np.eye(3), self.places.C[rows])
        return times_modes(along, self.modes.values(self.places.readings, rows))


@dataclass(frozen=True)
class PoseProcess(Process):
    """Errors of poses that last: tilt, heading, place on the floor and height have a size each."""

    modes: TimeModes
    sensor: int | None = field(default=None, kw_only=True)
    kind = DisturbanceKind.POSES

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of ``POSE_PARTS`` in rad^2 and m^2, for each of ``LASTING_S``."""
        parts = np.array(list(POSE_PARTS.values()))
        return tuple(np.kron(lasting(self.modes, seconds), parts) for seconds in LASTING_S)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what rotations and translations make of the field, shape (n, 3, m)."""
        F = self.places.pose_features(rows)
        return times_modes(F, self.modes.values(self.places.readings, rows))

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return what each part is wrong by, and how long it lasts."""
        tilt, heading, floor, height = np.sqrt(sizes).tolist()
        return {
            "tilt_deg": float(np.rad2deg(tilt)),
            "heading_deg": float(np.rad2deg(heading)),
            "floor_m": floor,
            "height_m": height,
            "lasting_s": LASTING_S[form],
        }


@dataclass(frozen=True)
class FieldProcess(NoiseAndWalk):
    """The field is not the map's for a time: it changed, or the map misses what is on the way."""

    sensor: int | None = field(default=None, kw_only=True)
    kind = DisturbanceKind.FIELD

    def features(self, rows: IntArray) -> FloatArray:
        """Return what fields along the axes of the map are in the lidar frame, shape (n, 3, m)."""
        readings = self.places.readings
        R_lidar_map = readings.R_map_lidar[rows].transpose(0, 2, 1)
        return times_modes(R_lidar_map, self.modes.values(readings, rows))


@dataclass(frozen=True)
class FloorModes:
    """Products of cosines over a rectangle of the floor.

    Attributes
    ----------
    low, length
        Its corner and its sides along x and y in metres, shapes (2,).
    waves
        Half waves of each mode along x and y, shape (J, 2).
    """

    low: FloatArray
    length: FloatArray
    waves: IntArray

    @classmethod
    def over(cls, x: FloatArray, finest: float) -> "FloorModes":
        """Return modes of all wavenumbers up to one in 1/m, around places, shape (N, 3)."""
        floor = x[:, :2]
        low = floor.min(axis=0) - BEYOND_M
        length = floor.max(axis=0) + BEYOND_M - low
        count = np.ceil(finest * length / np.pi).astype(int) + 1
        waves = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1).reshape(-1, 2)
        modes = cls(low, length, waves)
        return replace(modes, waves=waves[modes.wavenumber2 <= finest**2])

    @property
    def wavenumber2(self) -> FloatArray:
        """Squares of the wavenumbers in 1/m^2, shape (J,)."""
        return np.asarray(np.square(np.pi * self.waves / self.length).sum(axis=1))

    def values(self, x: FloatArray) -> FloatArray:
        """Return the modes, of mean square one over the floor, at places (n, 3): shape (n, J)."""
        return np.asarray(self._norm * np.cos(self._phase(x)).prod(axis=2))

    def slopes(self, x: FloatArray) -> FloatArray:
        """Return their derivatives along x and y at places (n, 3) in 1/m, shape (n, J, 2)."""
        phase = self._phase(x)
        falling = -np.sin(phase) * (np.pi * self.waves / self.length)
        return np.asarray(self._norm[:, None] * falling * np.cos(phase)[:, :, ::-1])

    @property
    def _norm(self) -> FloatArray:
        return np.asarray(np.sqrt(np.where(self.waves, 2.0, 1.0)).prod(axis=1))

    def _phase(self, x: FloatArray) -> FloatArray:
        return np.asarray((np.pi * (x[:, :2] - self.low) / self.length)[:, None] * self.waves)


@dataclass(frozen=True)
class Warp(Process):
    """The drive's frame is bent against the map's, in the plane of the floor.

    Poses on a bent frame are shifted, and turned with it: by half the curl of the shifts.
    ``spectra`` has the variances of the modes for shifts of unit variance over the drive, for each
    of ``WARP_M``, shape (2, J).
    """

    modes: FloorModes
    spectra: FloatArray
    sensor: int | None = field(default=None, kw_only=True)
    kind = DisturbanceKind.WARP

    @classmethod
    def of(cls, places: ReadingPlaces) -> "Warp":
        """Return the modes over the floor of some readings."""
        finest = np.sqrt(-2 * np.log(FAINT)) / min(WARP_M)  # wavenumber that still counts
        p = places.readings.p_map_lidar
        modes = FloorModes.over(p, finest)
        variance = np.exp(-0.5 * np.square(WARP_M)[:, None] * modes.wavenumber2)
        over_drive = np.square(modes.values(p)).mean(axis=0)
        return cls(places, modes, variance / (variance @ over_drive)[:, None])

    @cached_property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of two lengths together, m^2."""
        return (np.repeat(self.spectra, 2, axis=1),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what shifts along x and y of the map make of the field, shape (n, 3, m)."""
        readings, slope = self.places.readings, self.places.slope[rows]
        F = self.places.pose_features(rows)
        R, p = readings.R_map_lidar[rows], readings.p_map_lidar[rows]
        turn = np.einsum("nia,na->ni", F[:, :, :3], R[:, 2])  # about the map's vertical axis
        curl = self.modes.slopes(p)[:, :, ::-1] * [-1.0, 1.0]  # of a shift along x, and along y
        by_turn = np.einsum("ni,nja->nija", turn, 0.5 * curl).reshape(len(rows), 3, -1)
        return np.asarray(times_modes(slope[:, :, :2], self.modes.values(p)) + by_turn)

    def named(self, form: int, sizes: FloatArray) -> dict[str, float]:
        """Return the shift of both lengths together."""
        return {"shift_m": float(np.sqrt(sizes.sum()))}

r"""Processes that a drive may have beside noise: wander of H, errors of poses, a warped frame.

Each is a sum of modes with independent weights, whose variances follow a spectrum. Over the time of
a drive, u from 0 to 1, the modes are :math:`\sqrt 2 \cos j \pi u`. They are those of a random walk
about its mean (variances :math:`1 / (j \pi)^2`, the Karhunen-Loeve series of Brownian motion), and
near enough those of 1/f noise (1/j) and of errors that last for a time tau (Ornstein-Uhlenbeck:
:math:`2 \tau / T / (1 + (j \pi \tau / T)^2)`). Over a floor they are products of such cosines, with
the spectrum of a field that is smooth over a length (Solin and Sarkka, Statistics and Computing 30,
2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.pose_errors import pose_features, pose_seconds
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray, Readings
from l2m_gtsam.records.disturbance import DisturbanceKind

WANDER_MODES = 24  # slower ones hold all but 2 % of a walk; faster ones of 1/f noise are noise
POSE_MODES = 48  # of each of six errors, and of fields
LASTING_S = (1.0, 2.0, 4.0, 8.0)  # how long errors of poses may last
WARP_M = (3.0, 8.0)  # lengths over which a frame may be bent
BEYOND_M = 2.0  # cosines are level at their ends: these lie outside the drive
FAINT = 0.01  # of the largest variance of a mode: what less have is left out


@dataclass(frozen=True)
class Scene:
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
    """

    readings: Readings
    t: FloatArray
    C: FloatArray
    x: FloatArray
    b_lidar: FloatArray
    slope: FloatArray

    @classmethod
    def of(cls, readings: Readings, field_map: QueryableMap, estimate: Estimate) -> "Scene":
        """Return what a map says where an estimate puts readings."""
        R, t = readings.R_map_lidar, estimate.t[readings.sensor]
        x = np.einsum("nij,nj->ni", R, t) + readings.p_map_lidar
        field, gradient = field_map.field_and_gradient(x)
        R_lidar_map = R.transpose(0, 2, 1)
        b_lidar = np.einsum("nij,nj->ni", R_lidar_map, field)
        C = estimate.C()[readings.sensor]
        return cls(readings, t, C, x, b_lidar, R_lidar_map @ gradient)

    @cached_property
    def seconds(self) -> FloatArray:
        """When poses were taken, shape (N,)."""
        return pose_seconds(self.readings)


class Process(Protocol):
    """A process by its modes."""

    @property
    def kind(self) -> DisturbanceKind:
        """What it is."""

    @property
    def sensor(self) -> int | None:
        """Whose readings it is in; all if none is named."""

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Alternatives: each the variances of m weights by K parts of a unit size, shape (K, m)."""

    def features(self, rows: IntArray, /) -> FloatArray:
        """Return what weights do to the field in uT, lidar frame, shape (n, 3, m)."""


@dataclass(frozen=True)
class TimeModes:
    """Cosines over the time of each drive of a scene.

    Attributes
    ----------
    values
        Shape (N, D J) with D drives, zero in others' readings.
    frequency
        j of each, shape (D J,).
    duration
        Of its drive in seconds, shape (D J,).
    """

    values: FloatArray
    frequency: FloatArray
    duration: FloatArray

    @classmethod
    def of(cls, seconds: FloatArray, drive: IntArray, count: int) -> "TimeModes":
        """Return so many modes for times of drives, shapes (N,)."""
        drives, j = np.unique(drive), np.arange(1.0, count + 1)
        values, duration = np.zeros((len(seconds), len(drives) * count)), []
        for number, each in enumerate(drives):
            rows = np.flatnonzero(drive == each)
            u = seconds[rows] - seconds[rows].min()
            length = max(float(u.max()), 1e-9)
            own = slice(number * count, (number + 1) * count)
            values[rows, own] = np.sqrt(2) * np.cos(np.pi * j * (u / length)[:, None])
            duration += [length] * count
        return cls(values, np.tile(j, len(drives)), np.array(duration))


@dataclass(frozen=True)
class Wander:
    """H of a sensor wanders: 1/f noise, a random walk, or both."""

    scene: Scene
    sensor: int
    modes: TimeModes
    kind: DisturbanceKind = DisturbanceKind.WANDER

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of 1/f noise and of a random walk together, uT^2."""
        j = np.repeat(self.modes.frequency, 3)
        return (np.stack([1 / j, 1 / (np.pi * j) ** 2]),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what adds to the readings along their axes, shape (n, 3, m)."""
        modes = self.modes.values[rows]
        along = np.linalg.solve(self.scene.C[rows], np.broadcast_to(np.eye(3), (len(rows), 3, 3)))
        return np.asarray(np.einsum("nia,nj->nija", along, modes).reshape(len(rows), 3, -1))


@dataclass(frozen=True)
class PoseProcess:
    """Errors of poses that last; rotation and translation have sizes of their own."""

    scene: Scene
    modes: TimeModes
    kind: DisturbanceKind = DisturbanceKind.POSES
    sensor: int | None = None

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of rotation (rad^2) and of translation (m^2), for each of ``LASTING_S``."""
        turn, forms = np.repeat([1.0, 0.0], 3), []
        for lasting in LASTING_S:
            share = lasting / self.modes.duration
            variance = 2 * share / (1 + (np.pi * self.modes.frequency * share) ** 2)
            forms.append(np.stack([np.kron(variance, turn), np.kron(variance, 1 - turn)]))
        return tuple(forms)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what rotations and translations make of the field, shape (n, 3, m)."""
        scene, unit = self.scene, np.broadcast_to(np.eye(6), (len(rows), 6, 6))
        slope = scene.slope[rows] @ scene.readings.R_map_lidar[rows]
        F = pose_features(unit, scene.b_lidar[rows], slope, scene.t[rows])
        return np.asarray(
            np.einsum("nia,nj->nija", F, self.modes.values[rows]).reshape(len(rows), 3, -1)
        )


@dataclass(frozen=True)
class FieldProcess:
    """The field is not the map's for a time: it changed, or the map misses what is on the way."""

    scene: Scene
    modes: TimeModes
    kind: DisturbanceKind = DisturbanceKind.FIELD
    sensor: int | None = None

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of 1/f noise and of a random walk together, uT^2."""
        j = np.repeat(self.modes.frequency, 3)
        return (np.stack([1 / j, 1 / (np.pi * j) ** 2]),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what fields along the axes of the map are in the lidar frame, shape (n, 3, m)."""
        R_lidar_map = self.scene.readings.R_map_lidar[rows].transpose(0, 2, 1)
        found = np.einsum("nia,nj->nija", R_lidar_map, self.modes.values[rows])
        return np.asarray(found.reshape(len(rows), 3, -1))


@dataclass(frozen=True)
class Warp:
    """The drive's frame is bent against the map's, in the plane of the floor.

    Attributes
    ----------
    scene
        The readings.
    values
        Modes at their places, shape (N, J).
    wavenumber2
        Squares of the wavenumbers in 1/m^2, shape (J,).
    """

    scene: Scene
    values: FloatArray
    wavenumber2: FloatArray
    kind: DisturbanceKind = DisturbanceKind.WARP
    sensor: int | None = None

    @classmethod
    def of(cls, scene: Scene) -> "Warp":
        """Return the modes over the floor of a scene."""
        floor = scene.x[:, :2]
        low = floor.min(axis=0) - BEYOND_M
        length = floor.max(axis=0) + BEYOND_M - low
        highest = np.sqrt(-2 * np.log(FAINT)) / min(WARP_M)  # wavenumber that still counts
        count = np.ceil(highest * length / np.pi).astype(int) + 1
        i, j = (each.ravel() for each in np.meshgrid(*map(np.arange, count), indexing="ij"))
        k2 = (np.pi * i / length[0]) ** 2 + (np.pi * j / length[1]) ** 2
        near = np.flatnonzero(k2 <= highest**2)
        phase = np.pi * (floor - low) / length
        along = np.cos(phase[:, :1] * i[near]) * np.cos(phase[:, 1:] * j[near])
        norm = np.sqrt(np.where(i[near], 2.0, 1.0) * np.where(j[near], 2.0, 1.0))
        return cls(scene, norm * along, k2[near])

    @property
    def forms(self) -> tuple[FloatArray, ...]:
        """Of two lengths together, m^2."""
        variance = np.exp(-0.5 * np.square(WARP_M)[:, None] * self.wavenumber2)
        return (np.repeat(variance / variance.sum(axis=1, keepdims=True), 2, axis=1),)

    def features(self, rows: IntArray) -> FloatArray:
        """Return what shifts along x and y of the map make of the field, shape (n, 3, m)."""
        slope = self.scene.slope[rows, :, :2]
        return np.asarray(
            np.einsum("nia,nj->nija", slope, self.values[rows]).reshape(len(rows), 3, -1)
        )


def processes(scene: Scene, sensors: Sequence[int]) -> tuple[Process, ...]:
    """Return all that is looked for; errors of poses only where none are stated."""
    drive = scene.readings.of_drive
    slow = TimeModes.of(scene.seconds, drive, WANDER_MODES)
    found: list[Process] = [Wander(scene, sensor, slow) for sensor in sensors]
    fast = TimeModes.of(scene.seconds, drive, POSE_MODES)
    if len(sensors) > 1:  # of one sensor's wander it cannot be told
        found.append(FieldProcess(scene, fast))
    if scene.readings.pose_root is None:
        found.append(PoseProcess(scene, fast))
    return (*found, Warp.of(scene))

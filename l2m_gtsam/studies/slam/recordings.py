"""Recordings that others made, as drives with their truth, and odometry made of such poses."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, FloatArray, IntArray, Recording, SourceFile, Trajectory
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.options import Options
from l2m_gtsam.storage.files import source_file

SHIP = "model_ship_runs1-2.npz"
ROBOT = "aalto_robot_runs1-4.npz"
HANDHELD = "optitrack_handheld_2runs.npz"
EVERY = 20  # of the robot's poses, at 50 Hz,
EVERY_HANDHELD = 50  # and of those of the sensor in the hand, at 200 Hz
EARTH_UT = 50.0
"""The ship's field is in a unit of about the Earth's strength, here this many microtesla."""
SECOND = 1e9


@dataclass(frozen=True)
class TrueDrive:
    """A drive with one sensor at the tracked origin and a reading at each pose.

    Attributes
    ----------
    truth
        N true poses.
    field
        Readings along the axes of the vehicle in uT, shape (N, 3).
    source
        The file.
    """

    truth: Trajectory
    field: FloatArray
    source: SourceFile

    @property
    def path_m(self) -> float:
        """Length of the true path."""
        return float(np.linalg.norm(np.diff(self.truth.p, axis=0), axis=1).sum())

    def recording(self, odometry: Trajectory) -> Recording:
        """Return the drive as it would be recorded with an odometry."""
        series = FieldSeries("mag", "/mag", "lidar", self.truth.stamp_ns, self.field)
        return Recording(odometry, (series,), self.source)


def parts_of(site: str, known: Iterable[str]) -> tuple[str, int]:
    """Return the name and the number of a recording, such as ``ship-1``.

    Raises
    ------
    ConfigError
        It has no number, or another name than those that are known.
    """
    name, _, number = site.partition("-")
    if name not in known or not number.isdecimal():
        named = ", ".join(f"{each}-1" for each in known)
        raise ConfigError(f"`recordings`: {site!r} is none; they are named like {named}")
    return name, int(number)


@contextmanager
def arrays_of(path: Path, what: str, name: str) -> Iterator[Mapping[str, Any]]:
    """Give the arrays of a recording.

    Raises
    ------
    ConfigError
        They cannot be read, also inside: what of the recording, and from which file.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(
            f"{path}: no {what} can be read; set `data` to the folder of {name}"
        ) from error


def rotations(quaternion_wxyz: Any) -> FloatArray:
    """Return rotations from quaternions with the scalar first, shape (N, 3, 3)."""
    q = np.asarray(quaternion_wxyz, dtype=np.float64)
    return np.asarray(Rotation.from_quat(q, scalar_first=True).as_matrix())


def tracked(arrays: Mapping[str, Any], rows: IntArray) -> Trajectory:
    """Return the poses in rows of a recording."""
    stamps = np.round(SECOND * arrays["t"][rows]).astype(np.int64)
    p = arrays["position"][rows].astype(np.float64)
    return Trajectory(stamps, rotations(arrays["quaternion_wxyz"][rows]), p, "map", "lidar")


def ship_run(path: Path, run: int) -> TrueDrive:
    """Return a run of the model ship.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such run.
    """
    with arrays_of(path, f"run {run} of the model ship", SHIP) as arrays:
        p, field = arrays[f"position_{run}"], arrays[f"field_{run}"]
        period = float(arrays[f"period_{run}"])
        R = rotations(arrays[f"quaternion_wxyz_{run}"])
    stamps = np.round(SECOND * (period * np.arange(len(p)))).astype(np.int64)
    truth = Trajectory(stamps, R, p, "map", "lidar")
    return TrueDrive(truth, EARTH_UT * field, source_file(path))


def robot_run(path: Path, run: int) -> TrueDrive:
    """Return a pass of a wheeled robot with the first of its magnetometers, at its place.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such pass.
    """
    with arrays_of(path, f"pass {run} of the robot", ROBOT) as arrays:
        rows = np.flatnonzero((arrays["run"] == run) & arrays["ok"])[::EVERY]
        truth, field = tracked(arrays, rows), arrays["mag_body"][rows, 0].astype(np.float64)
        lever = arrays["sensor_positions_body"][0].astype(np.float64)
    return TrueDrive(replace(truth, p=truth.p + truth.R @ lever), field, source_file(path))


def handheld_run(path: Path, run: int) -> TrueDrive:
    """Return a run of a magnetometer in the hand, as if it were at the tracked origin.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such run.
    """
    with arrays_of(path, f"run {run} of the sensor in the hand", HANDHELD) as arrays:
        rows = np.flatnonzero(arrays["run"] == run)[::EVERY_HANDHELD]
        truth, field = tracked(arrays, rows), arrays["mag_uT"][rows].astype(np.float64)
    return TrueDrive(truth, field, source_file(path))


class Form(StrEnum):
    """How drifted steps are put together."""

    WORLD = "world"
    VEHICLE = "vehicle"


class DriftRecipe(Options):
    """Errors of every step."""

    level_m: float = Field(default=float(np.sqrt(1e-5)), ge=0)
    """White noise of a step along x and y of the world,"""
    vertical_m: float = Field(default=float(np.sqrt(1e-7)), ge=0)
    """along z, metres,"""
    turn_rad: float = Field(default=float(np.sqrt(1e-5)), ge=0)
    """and of its turn about each axis."""
    drift_m: float = Field(default=0.003)
    """What every step is too long by along x and along y of the world."""


def drifted(truth: Trajectory, recipe: DriftRecipe, form: Form, seed: int) -> Trajectory:
    """Return an odometry of a drive, which begins at the true pose.

    Parameters
    ----------
    truth
        N true poses.
    recipe
        Errors of each step between them.
    form
        How the steps are put together; their errors are the same.
    seed
        Of the noise.
    """
    rng, count = np.random.default_rng(seed), len(truth) - 1
    sigma = np.array([recipe.level_m, recipe.level_m, recipe.vertical_m])
    steps = np.diff(truth.p, axis=0) + sigma * rng.normal(size=(count, 3))
    steps += np.array([recipe.drift_m, recipe.drift_m, 0.0])
    errors = Rotation.from_rotvec(recipe.turn_rad * rng.normal(size=(count, 3))).as_matrix()
    back = truth.R[:-1].transpose(0, 2, 1)
    if form is Form.WORLD:
        own = chained(truth.R[0], errors @ truth.R[1:] @ back)
    else:  # the transposes of a chain along the vehicle's axes are one along fixed axes
        turns = back @ errors @ truth.R[1:]
        own = chained(truth.R[0].T, turns.transpose(0, 2, 1)).transpose(0, 2, 1)
        steps = np.einsum("nij,njk,nk->ni", own[:-1], back, steps)
    p = truth.p[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return replace(truth, R=own, p=p, covariance=None)


def chained(R: FloatArray, turns: FloatArray) -> FloatArray:
    """Return rotations, each the one before turned about fixed axes, shape (N, 3, 3)."""
    found = [R]
    for turn in turns:
        found.append(turn @ found[-1])
    return np.stack(found)

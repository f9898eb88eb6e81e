"""Recordings that others made and that are no part of this package, as drives with their truth."""

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FieldSeries, FloatArray, Recording, SourceFile, Trajectory
from l2m_gtsam.errors import ConfigError

SHIP = "model_ship_runs1-2.npz"
ROBOT = "aalto_robot_runs1-4.npz"
EVERY = 20  # of the robot's poses, at 50 Hz
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


def ship_run(path: Path, run: int) -> TrueDrive:
    """Return a run of the model ship.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such run.
    """
    try:
        content = path.read_bytes()
        with np.load(path, allow_pickle=False) as arrays:
            p, field = arrays[f"position_{run}"], arrays[f"field_{run}"]
            quaternion, period = arrays[f"quaternion_wxyz_{run}"], float(arrays[f"period_{run}"])
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(
            f"{path}: no run {run} of the model ship can be read; set `data` to the folder of "
            f"{SHIP}"
        ) from error
    R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    stamps = np.round(SECOND * period * np.arange(len(p))).astype(np.int64)
    truth = Trajectory(stamps, R, p, "map", "lidar")
    return TrueDrive(truth, EARTH_UT * field, SourceFile(str(path), sha256(content).hexdigest()))


def robot_run(path: Path, run: int) -> TrueDrive:
    """Return a pass of a wheeled robot with the first of its magnetometers, at its place.

    Raises
    ------
    ConfigError
        There is no such file, or it has no such pass.
    """
    try:
        content = path.read_bytes()
        with np.load(path, allow_pickle=False) as arrays:
            rows = np.flatnonzero((arrays["run"] == run) & arrays["ok"])[::EVERY]
            seconds, p = arrays["t"][rows], arrays["position"][rows].astype(np.float64)
            quaternion = arrays["quaternion_wxyz"][rows].astype(np.float64)
            field = arrays["mag_body"][rows, 0].astype(np.float64)
            lever = arrays["sensor_positions_body"][0].astype(np.float64)
        R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    except (OSError, KeyError, ValueError) as error:
        raise ConfigError(
            f"{path}: no pass {run} of the robot can be read; set `data` to the folder of {ROBOT}"
        ) from error
    stamps = np.round(SECOND * seconds).astype(np.int64)
    truth = Trajectory(stamps, R, p + R @ lever, "map", "lidar")
    return TrueDrive(truth, field, SourceFile(str(path), sha256(content).hexdigest()))

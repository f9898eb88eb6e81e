"""Calibrations made up for tests of what is done with them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import Distortion, FloatArray, SourceFile, SyncCounts
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    TimeOffset,
    Uncertainty,
)
from l2m_gtsam.storage.exports.export import Export, export_of, not_mounted

SIGMA = np.concatenate([np.full(3, 0.002), np.full(9, 0.003), np.full(3, 0.1)])


def sensor(
    name: str = "mag",
    R_mag_lidar: FloatArray | None = None,
    P: FloatArray | None = None,
    **changes: Any,
) -> SensorCalibration:
    """Return a solved sensor with C = R_mag_lidar @ P and correlated errors."""
    R = np.eye(3) if R_mag_lidar is None else R_mag_lidar
    mixing = np.eye(15) + 0.2 * np.random.default_rng(3).normal(size=(15, 15))
    covariance = mixing @ mixing.T * np.outer(SIGMA, SIGMA)
    facts: dict[str, Any] = {
        "sensor": name,
        "status": SensorStatus.SOLVED,
        "message": "converged",
        "t_lidar_mag": np.array([0.31, -0.12, 0.05]),
        "distortion": Distortion(R @ (np.eye(3) if P is None else P), np.array([3.0, -2.0, 7.0])),
        "R_lidar_mag": R.T,
        "covariance": covariance,
        "rotation_covariance": np.eye(3) * 1e-5,
        "noise": 0.2,
        "residuals": None,
        "undetermined": (),
        "sync": SyncCounts(100, 0, 0, 0, 0, 0, 100),
        "outside_map": 0,
        "time_offset": TimeOffset(0.012, 0.001, np.zeros(15), ""),
    }
    return SensorCalibration(**{**facts, **changes})


def open_in(name: str, parameters: slice, reason: str, **changes: Any) -> SensorCalibration:
    """Return a sensor of which some of the 15 parameters are not determined."""
    made = sensor(name)
    covariance = made.covariance.copy()
    covariance[parameters, parameters] = np.diag(np.full(len(SIGMA[parameters]), np.inf))
    facts = {"status": SensorStatus.UNDETERMINED, "undetermined": (reason,)}
    return sensor(name, covariance=covariance, **{**facts, **changes})


def unsolved(name: str, status: SensorStatus, message: str) -> SensorCalibration:
    """Return a sensor of which nothing is known."""
    return sensor(
        name,
        status=status,
        message=message,
        t_lidar_mag=np.full(3, np.nan),
        distortion=Distortion(np.full((3, 3), np.nan), np.full(3, np.nan)),
        R_lidar_mag=np.full((3, 3), np.nan),
        covariance=np.diag(np.full(15, np.inf)),
        rotation_covariance=np.diag(np.full(3, np.inf)),
    )


def calibration(*sensors: SensorCalibration, **changes: Any) -> CalibrationResult:
    """Return a calibration of these sensors, from files with names."""
    facts: dict[str, Any] = {
        "iterations": 3,
        "uncertainty": Uncertainty.FULL,
        "doubts": (),
        "disagreements": (),
        "bag": SourceFile("drives/yard -- north.mcap", "ab" * 32),
        "map": SourceFile("maps/yard.npz", "cd" * 32),
        "options": {"bag": {}},
        "versions": {"l2m-gtsam": "0.1.0"},
    }
    return CalibrationResult(sensors=sensors, **{**facts, **changes})


def mounted(sensors: Sequence[SensorCalibration], lidar_frame: str = "lidar") -> Export:
    """Return an export of sensors whose places are known."""
    return export_of(calibration(*sensors), not_mounted, lidar_frame, {})


def rotations() -> st.SearchStrategy[FloatArray]:
    """Return rotations of all kinds: any, half turns, and pitches of 90 degrees to rounding."""
    part = st.floats(-1, 1)
    quaternions = st.tuples(part, part, part, part).filter(lambda q: np.linalg.norm(q) > 1e-3)
    anyone = quaternions.map(lambda q: Rotation.from_quat(q).as_matrix())
    angle = st.floats(-np.pi, np.pi)
    pitch = st.sampled_from([np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, -np.pi / 2 + 1e-7, np.pi])
    steep = st.tuples(angle, pitch, angle).map(lambda a: Rotation.from_euler("xyz", a).as_matrix())
    return anyone | steep

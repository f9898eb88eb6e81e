"""Two drives of one vehicle, calibrated together: with a sensor that was moved, or more noise."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.calibrate import Calibrated, calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Distortion, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.recording.joining import joined
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.verdict import Verdict
from tests.drives.degenerate import STRONG, at_height, poses
from tests.drives.verdict import NOMINAL, SENSORS, read
from tests.worlds.exact import DipoleWorld

DAY_NS = 86_400_000_000_000
OPTIONS = CalibrationOptions(start=NOMINAL)


def way(phase: float, later_ns: int, count: int = 300) -> Trajectory:
    """Return a figure of eight that begins elsewhere, some time later."""
    s = np.linspace(0, 1, count) + phase
    p = at_height(3 * np.sin(6 * s), 2 * np.sin(12 * s), 0.1)
    path = poses(9 * s, p, 0.15, 0.15)
    return replace(path, stamp_ns=path.stamp_ns + later_ns)


def recorded(
    name: str,
    path: Trajectory,
    seed: int,
    sensors: tuple[KnownSensor, ...] = SENSORS,
    place: DipoleWorld = STRONG,
) -> Recording:
    """Return what sensors read on a drive."""
    rng = np.random.default_rng(seed)
    series = tuple(read(each, path, place, rng) for each in sensors)
    return Recording(path, series, SourceFile(f"drives/{name}.bag", f"digest of {name}"))


def monday() -> Recording:
    return recorded("monday", way(0.0, 0), 1)


def tuesday(sensors: tuple[KnownSensor, ...] = SENSORS) -> Recording:
    return recorded("tuesday", way(0.4, DAY_NS), 2, sensors)


def knocked() -> tuple[KnownSensor, ...]:
    """The second sensor was moved by 3 cm and turned by 3 degrees."""
    old = SENSORS[1]
    turn = Rotation.from_rotvec([0.0, 0.03, 0.04]).as_matrix()
    moved = KnownSensor(
        old.sensor,
        old.t_lidar_mag + np.array([0.03, 0.0, 0.0]),
        Distortion(turn @ old.distortion.C, old.distortion.H),
    )
    return (SENSORS[0], moved, SENSORS[2])


@dataclass(frozen=True)
class Made:
    """Several drives, their calibration, its figures and the verdict."""

    recording: Recording
    calibrated: Calibrated
    metrics: Metrics
    verdict: Verdict


def made(*drives: Recording) -> Made:
    recording = joined(drives)
    found = calibrated(recording, STRONG, OPTIONS)
    metrics = evaluate(recording, found, OPTIONS, QaOptions())
    return Made(recording, found, metrics, judge(found.result, metrics, QaOptions()))

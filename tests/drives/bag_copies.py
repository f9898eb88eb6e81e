"""Bags copied with corrected readings."""

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader

from l2m_gtsam.batch.exports import Application, Applied, apply_calibration
from l2m_gtsam.data import FloatArray
from l2m_gtsam.progress import silent
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.verdict import Judgement, Verdict
from l2m_gtsam.storage.bag import read_fields
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.calibration_file import write_calibration
from tests.drives.bags import Entry, ros
from tests.drives.calibrations import calibration, sensor

START = 1_700_000_000_000_000_000
STEP = 10_000_000
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
GOOD = Judgement(Verdict.of([], []), {})
VERDICT = "/l2m/verdict"


def readings(count: int = 30) -> FloatArray:
    """Return what the sensor of `made` reads, uT, shape (N, 3)."""
    return 20 + np.random.default_rng(0).normal(0, 10, (count, 3))


def made(**changes: Any) -> CalibrationResult:
    return calibration(sensor("imu/mag", TURN, np.diag([1.1, 0.9, 1.0]), **changes))


def entries(kind: str, field_ut: FloatArray, per_tesla: float = 1e-6) -> list[Entry]:
    """Readings with poses and text between them, two of which have one time."""
    make, found = ros(kind), []
    for k, row in enumerate(field_ut):
        stamp = START + k * STEP
        reading = make.magnetic(stamp, row * per_tesla, "mag_link")
        pose = make.pose_stamped(stamp, [k, 0, 0], [0, 0, 0, 1])
        found += [
            Entry("/imu/mag", "sensor_msgs/MagneticField", stamp + 2, reading),
            Entry("/pose", "geometry_msgs/PoseStamped", stamp + 2, pose),
            Entry("/note", "std_msgs/String", stamp + 5, make("std_msgs/String", data=f"{k}")),
        ]
    return found


def applied(
    folder: Path, bag: Path, result: CalibrationResult | None = None, **changes: Any
) -> Applied:
    """Apply a calibration, one without doubts if it was not judged, which gives `folder / out`."""
    path, given = folder / "calibration.yaml", made() if result is None else result
    write_calibration(path, replace(given, judgement=given.judgement or GOOD))
    out = folder / ("out.bag" if bag.suffix == ".bag" else "out")
    return apply_calibration(replace(Application(bag, path, out), **changes), silent)


def content(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Return times and bytes of all messages by topic, in their order."""
    found = defaultdict(list)
    reader: Any = Ros1Reader(path) if path.suffix == ".bag" else Ros2Reader(path)
    with reader:
        for connection, stamp, raw in reader.messages():
            found[connection.topic].append((stamp, bytes(raw)))
    return found


def connections(path: Path) -> dict[str, tuple[Any, ...]]:
    """Return what is said of each topic."""
    reader: Any = Ros1Reader(path) if path.suffix == ".bag" else Ros2Reader(path)
    with reader:
        return {c.topic: (c.msgtype, c.msgdef, c.digest, c.ext) for c in reader.connections}


def calibrated(path: Path, topic: str = "/imu/mag/calibrated") -> Any:
    """Return the corrected readings of a bag."""
    (series,) = read_fields(path, BagOptions(fields=(topic,)))
    return series

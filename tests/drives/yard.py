"""A calibrated sensor of the yard: its drives and its calibration, made once for all tests."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from tests.drives.bags import Entry, ros, write
from tests.support.command_line import l2m
from tests.support.left_out import no_pages
from tests.support.made_once import made_once
from tests.worlds.yard import NOISE, START, STEP, Yard, make_yard, route, world

T_LIDAR_MAG = np.array([0.12, -0.08, 0.05])
TURN = Rotation.from_euler("xyz", [0.2, -0.1, 1.3])
P = np.array([[1.03, 0.01, 0], [0.01, 0.97, -0.012], [0, -0.012, 1.01]])
C = TURN.as_matrix() @ P
H = np.array([4.0, -7.0, 2.0])
FIRST, DAY_NS = 5, 86_400_000_000_000


@dataclass(frozen=True)
class CalibratedYard:
    """What lies on disk; tests read it and change nothing.

    Attributes
    ----------
    yard
        The survey.
    map
        Of its west.
    drive
        Through the west, with one distorted sensor.
    calibration
        Of this sensor.
    """

    yard: Yard
    map: Path
    drive: Path
    calibration: Path


def calibrated_yard(factory: pytest.TempPathFactory) -> CalibratedYard:
    """Return the yard of this run of the tests."""
    folder = made_once(factory, "calibrated_yard", _make)
    calibration = folder / "first" / "calibration.yaml"
    return CalibratedYard(Yard.of(folder), folder / "map.npz", folder / "drive", calibration)


def _make(folder: Path) -> None:
    yard, field_map = make_yard(folder), folder / "map.npz"
    l2m("map", "build", yard.west, "--config", yard.config, "--out", field_map)
    with no_pages():  # nobody looks at its report
        calibrated(folder / "first", yard, field_map, written(folder, "mcap"), "mag")


def written(
    folder: Path,
    kind: str,
    name: str = "drive",
    seed: int = FIRST,
    offset: FloatArray = H,
    poses: int | None = None,
) -> Path:
    """Write a drive through the west with turns and tilts, and one distorted sensor.

    It has 550 poses, or only the first of them. Each seed is another day: drives of one time and
    one way would be one drive.
    """
    make, entries = ros(kind), []
    p, rng = route(-2.8, 0.2)[:poses], np.random.default_rng(seed)
    k = np.arange(len(p))
    angles = np.column_stack([0.05 * k, 0.3 * np.sin(0.31 * k), 0.3 * np.cos(0.43 * k)])
    R = Rotation.from_euler("ZYX", angles)
    field, _ = world().field_and_gradient(p + R.apply(T_LIDAR_MAG))
    readings = R.inv().apply(field) @ C.T + offset + rng.normal(0, NOISE, field.shape)
    start = START + (seed - FIRST) * DAY_NS
    for n, q in enumerate(R.as_quat()):
        stamp = start + n * STEP
        pose = make.pose_stamped(stamp, p[n], q)
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose))
        magnetic = make.magnetic(stamp, readings[n] * 1e-6)
        entries.append(Entry("/mag", "sensor_msgs/MagneticField", stamp, magnetic))
    return write(folder, kind, entries, name)


def calibrated(folder: Path, yard: Yard, field_map: Path, bag: Path, sensor: str) -> Path:
    """Calibrate one sensor from a start near its place, and return the file; JSON is YAML."""
    folder.mkdir()
    content = json.loads(yard.config.read_text())
    content["bag"]["fields"] = [f"/{sensor}"]
    content["calibration"] = {"start": {sensor: [0.1, -0.1, 0.0]}}
    config = folder / "c.yaml"
    config.write_text(json.dumps(content))
    l2m("calibrate", bag, "--map", field_map, "--config", config, "--out", folder)
    return folder / "calibration.yaml"

"""Sound files of formats that few drives have, beside those of ``tests.fuzz.corpus``."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from l2m_gtsam.records.fleet import Computation, DriveOutcome, RowKey
from l2m_gtsam.storage.record_files import write_outcome
from l2m_gtsam.storage.result_set import SET_FILE, published
from l2m_gtsam.studies.registry import STUDIES
from tests.drives.bags import Entry, Ros, ros, write
from tests.drives.clouds import entries, scan
from tests.drives.fleet_rows import sensor_row
from tests.fuzz.sound import BAGS, CASE, PLAIN_JSON, PLAIN_YAML, READ, WORDS, Sound

START = 1_700_000_000_000_000_000
STEP = 50_000_000
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


CHOICES: dict[str, dict[str, Any]] = {
    "odometry": {"poses": "/odom"},
    "transforms": {"tf": {"frame": "map", "child_frame": "lidar"}},
    "path": {"poses": "/path"},
    "vectors": {"poses": "/odom", "fields": ["/vector"], "units": "tesla"},
}
"""Parts of the bag of many types that a configuration chooses."""


def _config(folder: Path, name: str, chosen: dict[str, Any]) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps({"bag": chosen}))
    return path


def further_corpus(folder: Path, files: Path, bag: Path) -> list[Sound]:
    """Return sound files of rarer formats.

    Parameters
    ----------
    folder
        Where they go.
    files
        Results that are kept with the tests.
    bag
        A drive.
    """
    inspect = tuple(
        ("inspect", CASE, "--config", str(_config(folder, name, chosen)))
        for name, chosen in CHOICES.items()
    )
    made = [
        Sound(f"bag of many types {suffix}", _many_types(folder, kind), BAGS[suffix], inspect)
        for kind, suffix in (("ros1", ".bag"), ("mcap", ".mcap"))
    ]
    scans = Sound("bag with scans", _scans(folder), BAGS[".mcap"], ((READ, "scans", CASE),))
    return [*made, scans, *_poses(folder, bag), *_results(folder, files), *_studies(folder)]


def _many_types(folder: Path, kind: str) -> Path:
    """Return a bag whose poses, fields and recorded numbers are of most types that are read."""
    dialect, found = ros(kind), []
    for k in range(20):
        stamp, p = START + STEP * k, (0.05 * k, 0.0, 0.0)
        pose = dialect.pose(p, UPRIGHT)
        with_covariance = dialect(
            "geometry_msgs/PoseWithCovariance", pose=pose, covariance=np.eye(6).ravel() * 1e-4
        )
        still = dialect("geometry_msgs/Twist", linear=dialect.vector(p), angular=dialect.vector(p))
        messages = {
            "/odom": (
                "nav_msgs/Odometry",
                dialect(
                    "nav_msgs/Odometry",
                    header=dialect.header(stamp, "odom"),
                    child_frame_id="base",
                    pose=with_covariance,
                    twist=dialect(
                        "geometry_msgs/TwistWithCovariance", twist=still, covariance=np.zeros(36)
                    ),
                ),
            ),
            "/tf": (
                "tf2_msgs/TFMessage",
                dialect(
                    "tf2_msgs/TFMessage",
                    transforms=[dialect.transform(stamp, "map", "lidar", p, UPRIGHT)],
                ),
            ),
            "/mag": (
                "sensor_msgs/MagneticField",
                dialect.magnetic(stamp, (2e-5, 1e-7 * (k % 5), -4e-5), "mag"),
            ),
            "/vector": (
                "geometry_msgs/Vector3Stamped",
                dialect(
                    "geometry_msgs/Vector3Stamped",
                    header=dialect.header(stamp, "other"),
                    vector=dialect.vector((2e-5, 1e-7 * k, -4e-5)),
                ),
            ),
            "/imu": ("sensor_msgs/Imu", _imu(dialect, stamp)),
        }
        found += [Entry(topic, msgtype, stamp, each) for topic, (msgtype, each) in messages.items()]
    found.append(Entry("/path", "nav_msgs/Path", START + 20 * STEP, _path(dialect)))
    made = write(folder, kind, found, f"{kind}_many")
    return made if made.is_file() else next(made.glob("*.mcap"))


def _imu(dialect: Ros, stamp: int) -> object:
    covariances = {
        f"{part}_covariance": np.zeros(9)
        for part in ("orientation", "angular_velocity", "linear_acceleration")
    }
    return dialect(
        "sensor_msgs/Imu",
        header=dialect.header(stamp, "imu"),
        orientation=dialect.quaternion(UPRIGHT),
        angular_velocity=dialect.vector((0.0, 0.0, 0.1)),
        linear_acceleration=dialect.vector((0.0, 0.0, 9.8)),
        **covariances,
    )


def _path(dialect: Ros) -> object:
    poses = [dialect.pose_stamped(START + STEP * k, (0.05 * k, 0, 0), UPRIGHT) for k in range(20)]
    return dialect("nav_msgs/Path", header=dialect.header(START, "map"), poses=poses)


def _scans(folder: Path) -> Path:
    points = np.random.default_rng(4).uniform(-5, 5, (200, 3))
    found = entries([scan("mcap", START + 10 * STEP * k, points) for k in range(5)])
    return next(write(folder, "mcap", found, "scans").glob("*.mcap"))


def _poses(folder: Path, bag: Path) -> list[Sound]:
    """Return poses of KITTI, and their times."""
    poses, times = folder / "kitti.txt", folder / "times.txt"
    rows = [f"1 0 0 {0.1 * k:.3f} 0 1 0 0 0 0 1 0.5" for k in range(60)]
    poses.write_text("\n".join(rows) + "\n")
    times.write_text("\n".join(f"{1.7e9 + 0.05 * k:.9f}" for k in range(60)) + "\n")
    read = ("inspect", str(bag), "--poses")
    return [
        Sound("poses of KITTI", poses, WORDS, ((*read, CASE, "--pose-times", str(times)),)),
        Sound("times of KITTI", times, WORDS, ((*read, str(poses), "--pose-times", CASE),)),
    ]


def _results(folder: Path, files: Path) -> list[Sound]:
    """Return results that a later command reads."""
    outcome, listed = folder / "outcome.json", folder / "listed"
    key = RowKey("0" * 64, "1" * 64, "2" * 64, "1.0")
    made = Computation("2026-05-01T09:00:00Z", 3.0)
    row = DriveOutcome(key, "2026-05-01T08:00:00Z", 60.0, (sensor_row(),), "", True, made)
    write_outcome(outcome, row)
    names = ("calibration.yaml", "metrics.json")
    with published(listed, *names) as stage:
        for each in names:
            shutil.copy(files / each, stage)
    beside = tuple(listed / each for each in names)
    report = (("report", "."),)
    return [
        Sound("outcome of a drive", outcome, PLAIN_JSON, ((READ, "outcome", CASE),)),
        Sound("list of results", listed / SET_FILE, PLAIN_JSON, report, beside),
    ]


def _studies(folder: Path) -> list[Sound]:
    """Return the options of the studies."""
    found = []
    for name, study in STUDIES.items():
        path = folder / f"{name}.yaml"
        path.write_text(json.dumps(study.options().model_dump(mode="json")))
        found.append(
            Sound(f"options of {name}", path, PLAIN_YAML, ((READ, f"study {name}", CASE),))
        )
    return found

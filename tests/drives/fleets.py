"""A small fleet: a map, small bags of several vehicles, and bags that are broken."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l2m_gtsam.batch.maps import build_map_file
from l2m_gtsam.config import load_config
from l2m_gtsam.data import FieldSeries, KnownSensor, Recording, SourceFile, Trajectory
from l2m_gtsam.progress import silent
from l2m_gtsam.simulate.bag_writer import BagKind, write_bag
from tests.drives.degenerate import STRONG, eight, mounted
from tests.drives.verdict import read

PLACE = np.array([[0.2, -0.1, 0.15]])
DAY_NS = 86_400_000_000_000
# JSON is YAML. The map's prior is given, starts are known, nothing is compared: fast, same code.
CONFIG = {
    "bag": {"poses": "/odometry"},
    "mapping": {
        "model": {
            "kind": "sliding_gp",
            "sliding_gp": {"hyperparameters": {"length_scale": 0.9, "signal": 8.0, "noise": 0.1}},
        }
    },
    "calibration": {"start": {"mag_0": PLACE[0].tolist()}},
    "qa": {"halves": False},
}


@dataclass(frozen=True)
class Place:
    """Files that all vehicles share."""

    map: Path
    config: Path


def make_place(folder: Path) -> Place:
    """Survey the place and build its map."""
    folder.mkdir(parents=True, exist_ok=True)
    config = folder / "fleet.yaml"
    config.write_text(json.dumps(CONFIG))
    way = eight()
    rng = np.random.default_rng(2)
    parts = [way.p + np.array([0, 0, height]) for height in (0.0, 0.15, 0.3)]
    p = np.concatenate(parts) + rng.uniform(-0.25, 0.25, (3 * len(way.p), 3))
    R = np.concatenate([way.R] * 3)
    stamps = way.stamp_ns[0] + np.arange(len(p)) * 50_000_000
    survey = Trajectory(stamps, R, p, "map", "lidar")
    ideal = KnownSensor.ideal("suite")
    bag = folder / "survey.bag"
    write(bag, survey, (ideal,), seed=1)
    build_map_file([bag], folder / "map.npz", load_config(config), None, silent)
    return Place(folder / "map.npz", config)


def write(path: Path, way: Trajectory, sensors: tuple[KnownSensor, ...], seed: int) -> Path:
    """Write the bag of a drive."""
    rng = np.random.default_rng(seed)
    series = tuple(
        replace(read(each, way, STRONG, rng), topic=f"/{each.sensor}", frame=each.sensor)
        for each in sensors
    )
    return write_series(path, way, series)


def write_series(path: Path, way: Trajectory, series: tuple[FieldSeries, ...]) -> Path:
    """Write poses and readings as a bag, ROS1 or mcap by the path's suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = BagKind.ROS1 if path.suffix == ".bag" else BagKind.MCAP
    write_bag(path, kind, Recording(way, series, SourceFile("made up", "")))
    return path


def vehicle(path: Path, seed: int, day: int = 0, moved: float = 0.0) -> Path:
    """Write the bag of a vehicle's drive on a day, its sensor moved along x by some metres."""
    way = eight()
    places = PLACE + np.array([moved, 0, 0])
    way = replace(way, stamp_ns=way.stamp_ns + day * DAY_NS)
    return write(path, way, mounted(places), seed)


def not_a_bag(path: Path) -> None:
    """What somebody called a bag."""
    path.write_bytes(b"minutes of a meeting\n" * 40)


def truncated(path: Path) -> None:
    """A bag whose recorder ran out of disk."""
    content = vehicle(path, 1).read_bytes()
    path.write_bytes(content[: len(content) // 2])


def without_readings(path: Path) -> None:
    """A vehicle whose magnetometers were not recorded."""
    write(path, eight(), (), 1)


def in_gauss(path: Path) -> None:
    """A driver that publishes gauss as tesla."""
    way = eight()
    (series,) = (read(each, way, STRONG, np.random.default_rng(1)) for each in mounted(PLACE))
    wrong = replace(series, topic="/mag_0", frame="mag_0", field=series.field * 1e4)
    write_series(path, way, (wrong,))


def elsewhere(path: Path) -> None:
    """Poses in another frame than the map's."""
    write(path, replace(eight(), frame="odom"), mounted(PLACE), 1)


BROKEN = (not_a_bag, truncated, without_readings, in_gauss, elsewhere)

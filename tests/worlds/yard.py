"""A yard with a steel post, surveyed in two drives: small bags with scans of the post."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.cloud import write_cloud
from tests.drives.bags import Entry, ros, write
from tests.drives.clouds import scan
from tests.worlds.exact import DipoleWorld
from tests.worlds.quick_maps import QUICK_HARMONIC

START = 1_700_000_000_000_000_000
STEP = 100_000_000  # ns, in which the vehicle drives 6 cm
POST = np.array([0.2, 0.2])
NOISE = 0.1  # uT
PRIOR = {"length_scale": 0.8, "signal": 4.0, "noise": 0.2}
HARMONIC_PRIOR = {"floor_scale": 2.0, "floor_depth": 0.6, "noise": 0.1}


@dataclass(frozen=True)
class Yard:
    """What lies on disk.

    Attributes
    ----------
    west, east
        Mapping bags of the two halves, with half a metre in common.
    cloud
        The post as a point cloud.
    config
        A harmonic map with a given prior that is built fast.
    sliding
        A sliding Gaussian process with a given prior.
    """

    west: Path
    east: Path
    cloud: Path
    config: Path
    sliding: Path

    @classmethod
    def of(cls, folder: Path) -> "Yard":
        """Return the yard that lies in a folder."""
        return cls(
            west=folder / "west",
            east=folder / "east",
            cloud=folder / "post.ply",
            config=folder / "harmonic.yaml",
            sliding=folder / "sliding.yaml",
        )


def world() -> DipoleWorld:
    """The post as a column of dipoles in the Earth's field."""
    heights = np.arange(0.05, 2, 0.1)
    positions = np.column_stack([np.tile(POST, (len(heights), 1)), heights])
    return DipoleWorld(np.array([22.0, 3.0, -38.0]), positions, np.tile([0.4, 0.3, 0], (20, 1)))


def post() -> FloatArray:
    """Points on the surface of the post in the map, shape (N, 3)."""
    angle, height = np.meshgrid(np.arange(0, 2 * np.pi, 0.7), np.arange(0.0, 2, 0.05))
    around = 0.06 * np.column_stack([np.cos(angle.ravel()), np.sin(angle.ravel())])
    return np.column_stack([POST + around, height.ravel()])


def route(low: float, high: float) -> FloatArray:
    """Positions of a meander between two x in metres, shape (N, 3)."""
    line = np.arange(low, high, 0.06)
    lines = [
        np.column_stack([line[:: 1 if k % 2 else -1], np.full(len(line), -2 + 0.4 * k)])
        for k in range(11)
    ]
    plane = np.concatenate(lines)
    return np.column_stack([plane, 0.4 + 0.05 * np.sin(np.arange(len(plane)))])


def with_steel(position: FloatArray, moment: FloatArray) -> DipoleWorld:
    """Return the yard with steel that was brought: metres and A m^2, shapes (3,)."""
    return world().with_dipoles(position, moment)


def survey(
    folder: Path,
    name: str,
    p: FloatArray,
    seed: int,
    place: DipoleWorld | None = None,
    start: int = START,
) -> Path:
    """Write the bag of one drive, from a stamp in nanoseconds on, through a place as it is then."""
    make = ros("mcap")
    R = Rotation.from_rotvec(np.outer(np.linspace(0, 9, len(p)), [0, 0, 1]))
    field, _ = (place or world()).field_and_gradient(p)
    noise = np.random.default_rng(seed).normal(0, NOISE, field.shape)
    reading = (R.inv().apply(field) + noise) * 1e-6
    entries = []
    for k, q in enumerate(R.as_quat()):
        stamp = start + k * STEP
        pose = make.pose_stamped(stamp, p[k], q)
        entries.append(Entry("/pose", "geometry_msgs/PoseStamped", stamp, pose))
        magnetic = make.magnetic(stamp, reading[k])
        entries.append(Entry("/mag", "sensor_msgs/MagneticField", stamp, magnetic))
        if k % 50 == 0:
            seen = scan("mcap", stamp, R[k].inv().apply(post() - p[k]))
            entries.append(Entry("/points", "sensor_msgs/PointCloud2", stamp, seen))
    early = scan("mcap", start - 10 * STEP, post())
    entries.insert(0, Entry("/points", "sensor_msgs/PointCloud2", start, early))
    return write(folder, "mcap", entries, name)


def make_yard(folder: Path) -> Yard:
    """Write everything into a folder."""
    # JSON is YAML.
    bag = {"poses": "/pose", "fields": ["/mag"]}
    harmonic = {
        "kind": "harmonic",
        "harmonic": QUICK_HARMONIC | {"hyperparameters": HARMONIC_PRIOR},
    }
    sliding = {"kind": "sliding_gp", "sliding_gp": {"hyperparameters": PRIOR}}
    yard = Yard.of(folder)
    yard.config.write_text(json.dumps({"bag": bag, "mapping": {"model": harmonic}}))
    yard.sliding.write_text(json.dumps({"bag": bag, "mapping": {"model": sliding}}))
    write_cloud(yard.cloud, post())
    survey(folder, "west", route(-3, 0.5), 1)
    survey(folder, "east", route(0, 3), 2)
    return yard

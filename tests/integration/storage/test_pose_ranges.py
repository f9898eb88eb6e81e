"""Poses and readings with numbers that no pose and no sensor has."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from l2m_gtsam.errors import BagError
from l2m_gtsam.storage.bag import read_recording
from l2m_gtsam.storage.bag_options import BagOptions, TfChain
from l2m_gtsam.storage.inspect import inspect_bag
from tests.drives.bags import KINDS, Entry, ros, write

UNIT = (0.0, 0.0, 0.0, 1.0)
START = 1_700_000_000_000_000_000
COUNT = 20


def drive(
    folder: Path,
    kind: str = "mcap",
    p: tuple[float, ...] = (1.0, 2.0, 3.0),
    q: tuple[float, ...] = UNIT,
    tesla: tuple[float, ...] = (2e-5, 0.0, 4e-5),
) -> Path:
    """Return a bag whose seventh pose and reading are these."""
    dialect, entries = ros(kind), []
    for k in range(COUNT):
        stamp, odd = START + 100_000_000 * k, k == 7
        where, turned = (p, q) if odd else ((0.1 * k, 0.0, 0.0), UNIT)
        field = tesla if odd else (2e-5 + 1e-7 * k, 0.0, 4e-5)
        entries += [
            Entry(
                "/pose",
                "geometry_msgs/PoseStamped",
                stamp,
                dialect.pose_stamped(stamp, where, turned),
            ),
            Entry("/mag", "sensor_msgs/MagneticField", stamp, dialect.magnetic(stamp, field)),
        ]
    return write(folder, kind, entries)


ODD: dict[str, tuple[dict[str, Any], str]] = {
    "huge": ({"q": (1e200, 0.0, 0.0, 1.0)}, r"an orientation is \(1e\+200, 0, 0, 1\)"),
    "largest": ({"q": (1.7e308,) * 4}, "an orientation is"),
    "tiny": ({"q": (0.0, 0.0, 0.0, 1e-200)}, "an orientation is"),
    "short": ({"q": (0.0, 0.0, 0.0, 0.4)}, "an orientation is"),
    "long": ({"q": (0.0, 2.0, 2.0, 2.0)}, "an orientation is"),
    "zero": ({"q": (0.0,) * 4}, "an orientation is all zero"),
    "far": ({"p": (0.0, -1e200, 0.0)}, r"a position has a coordinate of 1e\+200 m"),
}


@pytest.mark.parametrize("name", ODD)
def test_poses_that_cannot_be_are_refused_and_inspect_says_so(tmp_path: Path, name: str) -> None:
    changes, reason = ODD[name]
    bag = drive(tmp_path, **changes)
    with pytest.raises(BagError, match=reason):
        read_recording(bag, BagOptions())
    report = inspect_bag(bag, BagOptions())
    assert [each for each in report.obstacles if each.startswith("/pose: refused: ")]


@pytest.mark.parametrize("kind", KINDS)
def test_sound_poses_are_no_obstacle(tmp_path: Path, kind: str) -> None:
    bag = drive(tmp_path, kind, q=(0.0, 0.0, 0.0, 0.99))
    assert inspect_bag(bag, BagOptions()).obstacles == ()
    assert len(read_recording(bag, BagOptions()).trajectory) == COUNT


@pytest.mark.parametrize("tesla", [(1e200, 0.0, 0.0), (-1.7e308,) * 3, (np.inf, 0.0, 0.0)])
def test_readings_that_cannot_be_count_as_none(tmp_path: Path, tesla: tuple[float, ...]) -> None:
    (series,) = read_recording(drive(tmp_path, tesla=tesla), BagOptions()).series
    assert np.flatnonzero(~np.isfinite(series.field).all(axis=1)).tolist() == [7]


@pytest.mark.parametrize(("frame", "refused"), [("lidar", True), ("camera", False)])
def test_links_beside_the_chain_do_not_matter(tmp_path: Path, frame: str, refused: bool) -> None:
    dialect, entries = ros("mcap"), []
    for k in range(COUNT):
        stamp = START + 100_000_000 * k
        moves = [
            dialect.transform(
                stamp, "map", child, (0.1 * k, 0, 0), (1e200, 0, 0, 1) if child == frame else UNIT
            )
            for child in ("lidar", "camera")
        ]
        entries += [
            Entry(
                "/tf", "tf2_msgs/TFMessage", stamp, dialect("tf2_msgs/TFMessage", transforms=moves)
            ),
            Entry(
                "/mag",
                "sensor_msgs/MagneticField",
                stamp,
                dialect.magnetic(stamp, (k * 1e-7, 0, 4e-5)),
            ),
        ]
    bag = write(tmp_path, "mcap", entries)
    options = BagOptions(tf=TfChain(frame="map", child_frame="lidar"))
    obstacles = inspect_bag(bag, options).obstacles
    assert bool([each for each in obstacles if "an orientation is" in each]) == refused

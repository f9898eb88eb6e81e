"""A map that is loaded and saved again keeps where it came from."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import l2m_gtsam as l2m
from l2m_gtsam.batch.files import SavedMap, origin_of
from l2m_gtsam.batch.maps import write_map
from l2m_gtsam.data import LidarMap
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.build import MapOptions, build_map

POINTS = np.random.default_rng(5).uniform(0, 2, (40, 3))
BAG = {"path": "survey.bag", "sha256": "ab" * 32}
SUITE = {"path": "suite.yaml", "sha256": "cd" * 32, "verdict": "fail"}
PROVENANCE: dict[str, Any] = {"bags": [BAG], "suite": SUITE, "frame": "hall", "version": "0.0.1"}


@pytest.mark.parametrize("frame", [None, "yard"])
def test_a_copy_says_what_its_source_says(tmp_path: Path, frame: str | None) -> None:
    first, second = tmp_path / "map.npz", tmp_path / "copy.npz"
    field_map = build_map(POINTS, 20 + POINTS, MapOptions(kind="bilinear"))
    write_map(first, field_map, PROVENANCE, LidarMap(POINTS, np.eye(3)[None], POINTS[:1]))
    l2m.save_map(second, l2m.load_map(first), frame=frame, source=first)
    old, new = SavedMap.read(first), SavedMap.read(second)
    assert new.state.provenance == {**old.state.provenance, "frame": frame or "hall"}
    assert new.doubts == ("it was made with suite.yaml, whose verdict is FAIL",)
    assert origin_of(new.state.provenance) == origin_of(old.state.provenance)
    assert new.state.lidar is not None
    np.testing.assert_array_equal(new.state.lidar.points, POINTS)
    if frame is None:
        assert first.read_bytes() == second.read_bytes()


def test_a_source_has_to_be_a_map(tmp_path: Path) -> None:
    field_map = build_map(POINTS, 20 + POINTS, MapOptions(kind="bilinear"))
    with pytest.raises(MapError, match="no such map file"):
        l2m.save_map(tmp_path / "copy.npz", field_map, source=tmp_path / "map.npz")

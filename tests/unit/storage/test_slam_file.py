"""``slam.json`` whose poses can be none: one line, whatever would be drawn of them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.localisation import StartVerdict
from l2m_gtsam.records.localisation_file import StartRecord
from l2m_gtsam.storage.record_files import read_slam, write_slam

Edit = Callable[[dict[str, Any]], None]


def less_odometry(content: dict[str, Any]) -> None:
    content["odometry"].pop()


def more_odometry(content: dict[str, Any]) -> None:
    content["odometry"] += content["odometry"][:1] * 100


def no_poses(content: dict[str, Any]) -> None:
    content["poses"], content["odometry"] = [], []


def of(part: str, name: str, value: Any) -> Edit:
    def edit(content: dict[str, Any]) -> None:
        assert name in content[part][3]
        content[part][3][name] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "told"),
    [
        (less_odometry, r"odometry must have the shape \(K\) with K = 35"),
        (more_odometry, r"odometry must have the shape \(K\) with K = 35"),
        (no_poses, "no poses"),
        (of("poses", "quaternion_xyzw", [0, 0, 0, 0]), "all zero"),
        (of("odometry", "quaternion_xyzw", ["NaN"] * 4), "must be a unit quaternion"),
        (of("odometry", "quaternion_xyzw", [1e20, 0, 0, 0]), "must be a unit quaternion"),
        (of("poses", "p", ["NaN", 0, 0]), "a coordinate of nan m"),
        (of("odometry", "p", [0, "Infinity", 0]), "a coordinate of inf m"),
        (of("poses", "p", [0, 1e12, 0]), r"a coordinate of 1e\+12 m"),
    ],
)
def test_poses_that_can_be_none(tmp_path: Path, repository: Path, edit: Edit, told: str) -> None:
    content = json.loads((repository / "tests" / "files" / "slam.json").read_text())
    path = tmp_path / "slam.json"
    path.write_text(json.dumps(content))
    assert len(read_slam(path).poses) == 35
    edit(content)
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match=told):
        read_slam(path)


def test_a_start_without_a_second_has_the_margin_that_the_legend_says(
    tmp_path: Path, repository: Path
) -> None:
    found = read_slam(repository / "tests" / "files" / "slam.json")
    start = StartRecord(StartVerdict.UNIQUE, "found", float("nan"), 9.0, 90, 12, ())
    path = tmp_path / "slam.json"
    write_slam(path, replace(found, start=start))
    content = json.loads(path.read_text())
    assert f"{content['start']['margin']} without a second" in content["legend"]["start"]

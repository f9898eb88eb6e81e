"""What was found on a drive is in its calibration's file, and comes back."""

from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.records.error_budget import (
    Disturbance,
    DisturbanceKind,
    ErrorCause,
    StatedSize,
    VarianceShare,
)
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from tests.drives.calibrations import calibration, sensor

FOUND = (
    Disturbance(DisturbanceKind.WANDER, {"noise_ut": 0.02, "walk_ut": 0.3}, 40.5, "mag"),
    Disturbance(
        DisturbanceKind.POSES,
        {"tilt_deg": 0.2, "heading_deg": 0.1, "floor_m": 0.005, "height_m": 0.0, "lasting_s": 2.0},
        99.0,
    ),
    Disturbance(DisturbanceKind.FIELD, {"noise_ut": 0.2, "walk_ut": 0.0}, 12.0),
    Disturbance(DisturbanceKind.WARP, {"shift_m": 0.01}, 7.0),
)


def test_it_reads_back_equal(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    write_calibration(path, calibration(sensor("mag"), disturbances=FOUND))
    assert read_calibration(path).disturbances == FOUND


def test_shares_and_stated_sizes_read_back_equal(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    shares = (
        VarianceShare(ErrorCause.MAP, 0.7, 0.4, 0.9),
        VarianceShare(ErrorCause.NOISE, 0.3, 0.6, 0.1),
    )
    sizes = (
        StatedSize(ErrorCause.NOISE, 3.1, 120.5, "mag"),
        StatedSize(ErrorCause.POSES, 0.4, 30.0),
    )
    with_shares = replace(sensor("mag"), variance_shares=shares)
    write_calibration(path, calibration(with_shares, stated=sizes))
    found = read_calibration(path)
    assert found["mag"].variance_shares == shares
    assert found.stated == sizes


def test_where_nothing_was_found_nothing_is_said(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    write_calibration(path, calibration(sensor("mag")))
    assert "\ndisturbances" not in path.read_text(encoding="utf-8")
    assert read_calibration(path).disturbances == ()


def test_another_kind_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    write_calibration(path, calibration(sensor("mag"), disturbances=FOUND[:1]))
    text = path.read_text(encoding="utf-8").replace("kind: wander", "kind: ghost")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=r"disturbances.*kind"):
        read_calibration(path)

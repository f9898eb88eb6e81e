"""A calibration that was changed after it was written is noticed by every command."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.map_file import load_map, save_map
from l2m_gtsam.storage.yaml_file import read_yaml, write_yaml
from tests.drives.yard import CalibratedYard
from tests.support.command_line import complaint_here, l2m


@pytest.fixture
def moved(place: CalibratedYard, tmp_path: Path) -> Path:
    """A calibration alone in a folder, whose sensor is said to be 100 mm elsewhere."""
    content = read_yaml(place.calibration, CalibrationError)
    content["sensors"]["mag"]["t_lidar_mag"][0] += 0.1
    path = tmp_path / "moved" / "calibration.yaml"
    path.parent.mkdir()
    write_yaml(path, content, "")
    return path


def test_every_command_notices(place: CalibratedYard, moved: Path, tmp_path: Path) -> None:
    shutil.copy(place.calibration.parent / "metrics.json", moved.parent)
    out = tmp_path / "out"
    commands: list[tuple[str | Path, ...]] = [
        ("export", moved, "--format", "json", "--out", out),
        ("apply", place.drive, "--calibration", moved, "--out", out),
        ("validate", place.drive, "--calibration", moved, "--map", place.map),
        ("validate", "--calibration", place.calibration, "--compare", moved),
        ("report", moved.parent),
        ("map", "build", place.drive, "--suite", moved, "--out", tmp_path / "map.npz"),
    ]
    for command in commands:
        told = complaint_here(*command)
        assert f"{moved}: was changed after it was written" in told, command
        assert "restore the file" in told
    assert not out.exists()
    assert not (moved.parent / "report.html").exists()


def test_a_report_needs_the_figures_that_it_was_written_with(
    place: CalibratedYard, tmp_path: Path
) -> None:
    shutil.copy(place.calibration, tmp_path)
    metrics = json.loads((place.calibration.parent / "metrics.json").read_text())
    metrics["metrics"]["drive"]["heave"] += 1e-9
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    told = complaint_here("report", tmp_path)
    assert "metrics.json: is not the file that calibration.yaml was written with" in told


def test_page_file_and_terminal_have_one_id(place: CalibratedYard, tmp_path: Path) -> None:
    for name in ("calibration.yaml", "metrics.json"):
        shutil.copy(place.calibration.parent / name, tmp_path)
    source = tmp_path / "calibration.yaml"
    seen = []
    for limit in ("0.01", "1e-6"):
        config = tmp_path / "limits.yaml"
        config.write_text(f"qa: {{position_sigma_m: {{warn: {limit}, fail: 5}}}}\n")
        last = l2m("report", tmp_path, "--config", config).out.splitlines()[-1]
        report_id = read_calibration(source).report_id
        assert last == f"report id: {report_id[:16]}"
        page = (tmp_path / "report.html").read_text()
        assert re.findall(r"<code>([0-9a-f]{64})</code>", page) == [report_id]
        assert page.count(f"<code>{report_id[:16]}</code>") == 2
        digests = [
            hashlib.sha256(each.read_bytes()).hexdigest()
            for each in (source, tmp_path / "metrics.json")
        ]
        for digest in digests:
            assert f"sha256 {digest}" in page
        seen.append(report_id)
    assert seen[0] != seen[1]


def test_entries_can_be_added_later(place: CalibratedYard, tmp_path: Path) -> None:
    """They are part of the file, and of the id."""
    for name in ("calibration.yaml", "metrics.json"):
        shutil.copy(place.calibration.parent / name, tmp_path)
    config = tmp_path / "entries.yaml"
    config.write_text('report: {operator: A. Mann, "serial number": "0123"}\n')
    l2m("report", tmp_path, "--config", config)
    found = read_calibration(tmp_path / "calibration.yaml")
    assert found.options["report"] == {"operator": "A. Mann", "serial number": "0123"}
    assert found.report_id != read_calibration(place.calibration).report_id
    assert "<dt>operator</dt><dd>A. Mann</dd>" in (tmp_path / "report.html").read_text()
    l2m("report", tmp_path)
    assert read_calibration(tmp_path / "calibration.yaml").report_id == found.report_id


def test_a_file_says_when_and_from_what(place: CalibratedYard) -> None:
    """Of the drive, of its frames and of the map's survey."""
    found = read_calibration(place.calibration)
    (drive,) = found.recorded
    assert drive.when.begun is not None
    assert (drive.frame, drive.poses) == ("map", None)
    assert found.map_origin is not None
    assert found.map_origin.surveyed.begun is not None
    (survey,) = found.map_origin.sources
    assert (survey.role, len(survey.sha256)) == ("survey", 64)
    assert "python" in found.versions


def test_map_info_names_suite_and_survey(place: CalibratedYard, tmp_path: Path) -> None:
    state = load_map(place.map)
    suite = {"path": "suite.yaml", "sha256": "ab" * 32}
    path = tmp_path / "map.npz"
    save_map(path, replace(state, provenance={**state.provenance, "suite": suite}))
    out = l2m("map", "info", path).out
    assert f"suite.yaml, {'ab' * 32}" in out
    assert str(state.provenance["surveyed"]["begun"])[:10] in out


def test_what_is_exported_names_the_report(place: CalibratedYard, tmp_path: Path) -> None:
    report_id = read_calibration(place.calibration).report_id
    for name in ("json", "urdf", "kalibr", "px4"):
        l2m("export", place.calibration, "--format", name, "--out", tmp_path / name)
        assert report_id in (tmp_path / name).read_text()

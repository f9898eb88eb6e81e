"""What head and provenance of a report say: when, by whom, of which files, in which frames."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from l2m_gtsam.batch.files import origin_of
from l2m_gtsam.config import load_config
from l2m_gtsam.data import SourceFile
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.calibration_page import calibration_page
from l2m_gtsam.qa.report.facts import UNSET, entries_of, facts_of, files_of, lidar_frame
from l2m_gtsam.qa.verdict.calibration import judge, judgement_of
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.map_diary import UNDATED, MapDrive
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.provenance import MapOrigin, NamedSource, RecordedDrive, dated
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.record_files import read_metrics

FILES = Path(__file__).parents[2] / "files"
SURVEYED = MapDrive("2026-11-01T08:00:00Z", "2026-11-01T08:30:00Z")
DRIVEN = MapDrive("2026-11-21T20:30:00Z", "2026-11-21T20:41:10Z")
SUITE = NamedSource("suite", "suite.yaml", "cd34")


@pytest.fixture(scope="module")
def old() -> CalibrationResult:
    """Of a version that knew neither dates nor frames."""
    return read_calibration(FILES / "calibration.yaml")


@pytest.fixture(scope="module")
def metrics() -> Metrics:
    return read_metrics(FILES / "metrics.json")


@pytest.fixture(scope="module")
def known(old: CalibrationResult) -> CalibrationResult:
    """The same with all that is known of it today."""
    drive = RecordedDrive(DRIVEN, "map", "base_link", SourceFile("poses.tum", "ab12"))
    entries = {"operator": "M. <b>Muster</b>", "serial number of mag_00": "0123"}
    return replace(
        old,
        recorded=(drive,),
        map_origin=MapOrigin(SURVEYED, None, (NamedSource("survey", "s.bag", "ef56"), SUITE)),
        options={**old.options, "report": entries},
    )


def test_a_file_holds_it(known: CalibrationResult, tmp_path: Path) -> None:
    write_calibration(tmp_path / "c.yaml", known)
    found = read_calibration(tmp_path / "c.yaml")
    assert (found.recorded, found.map_origin) == (known.recorded, known.map_origin)
    assert entries_of(found.options) == entries_of(known.options)


def test_dates_are_said(old: CalibrationResult, known: CalibrationResult) -> None:
    assert facts_of(known) == {
        "operator": "M. <b>Muster</b>",
        "serial number of mag_00": "0123",
        "drive recorded": "2026-11-21 20:30:00 to 20:41:10 UTC",
        "map surveyed": "2026-11-01 08:00:00 to 08:30:00 UTC",
        "age of the map at the drive": "20 days",
    }
    assert facts_of(old) == {}
    unset = replace(known, recorded=(replace(known.recorded[0], when=dated(0, 10**9)),))
    assert facts_of(unset)["drive recorded"] == UNSET
    assert unset.map_age_days is None


def test_a_map_is_as_old_as_its_last_drive(known: CalibrationResult) -> None:
    origin = known.map_origin
    assert origin is not None
    later = replace(origin, updated="2026-11-21T08:30:00Z")
    assert later.age_days(DRIVEN) == 0.5
    assert facts_of(replace(known, map_origin=later))["age of the map at the drive"] == "12.0 hours"
    assert origin.age_days(MapDrive("2026-02-31T00:00:00Z", None)) is None


@pytest.mark.parametrize(("days", "warns"), [(None, False), (21.0, False), (19.0, True)])
def test_an_old_map_is_a_warning_where_one_asks(
    known: CalibrationResult, metrics: Metrics, days: float | None, warns: bool
) -> None:
    options = QaOptions(map_days=days)
    told = [each for each in judge(known, metrics, options).reasons if "days old" in each.text]
    assert [each.level for each in told] == ([Level.WARN] if warns else [])
    limits = judgement_of(known, metrics, options).thresholds
    assert limits.get("map_days", "absent") == ("absent" if days is None else days)


def test_files_are_named(known: CalibrationResult) -> None:
    found = {role: each.sha256 for role, each in files_of(known)}
    assert found["poses of drive"] == "ab12"
    assert (found["of the map: survey"], found["of the map: suite"]) == ("ef56", "cd34")
    assert {"drive", "map"} < found.keys()


def test_the_frame_of_positions_is_named(known: CalibrationResult) -> None:
    assert lidar_frame(known) == "base_link"
    fixed = {"translation": [0.1, 0.0, 0.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
    bag = {**known.options["bag"], "tracked_to_lidar": fixed}
    moved = replace(known, options={**known.options, "bag": bag})
    assert lidar_frame(moved) == "base_link, moved by bag.tracked_to_lidar"


def test_the_page_defines_and_prints_what_a_certificate_needs(
    known: CalibrationResult, metrics: Metrics
) -> None:
    """What stands in closed details is not printed; all of this does not."""
    page = calibration_page(known, metrics, QaOptions())
    printed = re.sub(r"<details.*?</details>", "", page, flags=re.DOTALL)
    for words in (
        "M. &lt;b&gt;Muster&lt;/b&gt;",
        "2026-11-21 20:30:00 to 20:41:10 UTC",
        "20 days",
        "one standard deviation (k = 1",
        "B_meas = C B_lidar + H",
        "in the lidar frame (base_link)",
        "Rz(yaw) Ry(pitch) Rx(roll)",
        "poses.tum",
        "sha256 cd34",
        *("C_xx", "C_zz", "H_z", "time offset (s)", "roll, pitch, yaw (°)"),
        *("covariance_order", "position_sigma_m", "graph_iterations: 2", "Account of its readings"),
    ):
        assert words in printed, words
    assert "<b>Muster" not in page
    style = page[page.index("@media print") :]
    assert re.search(r"\.folded \{ display: block;", style)
    kept = printed[printed.index('<div class="kept">') : printed.index('<section id="annex"')]
    assert 'id="provenance"' in kept  # the signature has company on its page
    assert 'id="signature"' in kept
    assert re.search(r"\.kept \{ break-inside: avoid;", style)
    assert printed.count('class="folded"') == page.count('<details class="fold">') == 5


def test_a_page_without_all_that_is_drawn(old: CalibrationResult, metrics: Metrics) -> None:
    """Of a file of an earlier version, and with options that hold anything."""
    odd = replace(old, options={"report": {"a": 1, "b": ["x"], "c": "kept"}, "bag": 3})
    page = calibration_page(odd, metrics, QaOptions())
    assert "<dt>c</dt><dd>kept</dd>" in page
    assert "<dt>b</dt>" not in page


@pytest.mark.parametrize(
    ("provenance", "sources"),
    [
        ({"bags": [{"path": "a", "sha256": "1"}], "suite": None}, [("survey", "a", "1")]),
        ({"bags": 3, "suite": {"path": 3, "sha256": "1"}, "surveyed": {"begun": 1}}, []),
        ({"suite": {"path": "s", "sha256": "2", "verdict": "fail"}}, [("suite", "s", "2")]),
        (
            {"updates": [{"suite": {"path": "u", "sha256": "3"}}, 7]},
            [("suite of an update", "u", "3")],
        ),
    ],
)
def test_what_a_map_says_of_its_origin(
    provenance: dict[str, Any], sources: list[tuple[str, str, str]]
) -> None:
    """Its file may hold anything."""
    origin = origin_of(provenance)
    assert origin.surveyed == UNDATED
    assert [(each.role, each.path, each.sha256) for each in origin.sources] == sources


@pytest.mark.parametrize(
    ("entries", "told"),
    [
        ("{serial: 0123}", "text is expected; put numbers and dates in quotes"),
        ("{tested: 2026-11-28}", "text is expected"),
        (f"{{place: {'x' * 301}}}", "at most 300 characters"),
        (f"{{{', '.join(f'e{k}: x' for k in range(41))}}}", "at most 40 items"),
        ("[vehicle]", "report: "),
    ],
)
def test_entries_are_short_texts(tmp_path: Path, entries: str, told: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(f"report: {entries}\n")
    with pytest.raises(ConfigError, match=told):
        load_config(path)

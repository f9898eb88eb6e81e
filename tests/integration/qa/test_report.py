"""A report from files alone, and figures that agree with the solve's own."""

import json
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from l2m_gtsam.batch.drives import CALIBRATION_FILE, METRICS_FILE, EvaluatedCalibration
from l2m_gtsam.batch.reports import (
    REPORT_FILE,
    SLAM_FILE,
    calibration_results,
    report_calibration,
    report_folder,
    write_report,
)
from l2m_gtsam.calibration.calibrate import Calibrated, calibrated
from l2m_gtsam.calibration.trust import judged
from l2m_gtsam.config import Config
from l2m_gtsam.errors import OutputError
from l2m_gtsam.qa.evaluate import evaluate
from l2m_gtsam.qa.metrics.evidence import DriveEvidence, sensor_evidence
from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.verdict import Level
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.record_files import read_metrics, write_metrics
from tests.drives.verdict import EIGHT, changed_place, drive, with_series
from tests.support.command_line import complaint_here, l2m


@dataclass(frozen=True)
class Made:
    """A calibration, its metrics, and the folder where both are."""

    calibrated: Calibrated
    metrics: Metrics
    folder: Path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    drive = changed_place()
    found = calibrated(drive.recording, drive.field_map, drive.options)
    metrics = evaluate(drive.recording, found, drive.options, QaOptions())
    folder = tmp_path_factory.mktemp("made")
    options = Config(calibration=drive.options).model_dump(mode="json")
    write_calibration(folder / CALIBRATION_FILE, replace(found.result, options=options))
    write_metrics(folder / METRICS_FILE, metrics)
    return Made(found, metrics, folder)


@pytest.fixture(scope="module")
def steps() -> list[tuple[str, float]]:
    """How far the report said that it was."""
    return []


@pytest.fixture(scope="module")
def reported(made: Made, steps: list[tuple[str, float]]) -> tuple[Level, str]:
    """The verdict and the page, made from the files."""
    level = report_folder(made.folder, None, lambda *how_far: steps.append(how_far)).judgement.level
    return level, (made.folder / REPORT_FILE).read_text()


def test_residuals_are_those_of_the_graph(made: Made) -> None:
    """Evidence asks the map anew: the same numbers to rounding, rejected readings among them."""
    solution = made.calibrated.solution
    graph = judged(
        solution.readings, made.calibrated.field_map, solution.estimate, solution.rejected
    )
    evidence = DriveEvidence(solution.readings, solution.inside, solution.rejected)
    for index, sensor in enumerate(made.calibrated.result.sensors):
        rows = solution.readings.rows_of(index)
        found = sensor_evidence(evidence, sensor, made.calibrated.field_map)
        np.testing.assert_allclose(found.residual, graph.residual[rows], atol=1e-9)
        np.testing.assert_array_equal(found.used, ~solution.rejected[rows])
        assert sensor.residuals is not None
        figures = made.metrics.sensors[index].fit
        assert figures.readings == sensor.residuals.readings
        # The last step moves clocks by up to 0.1 ms after the poses were taken.
        np.testing.assert_allclose(figures.rms, sensor.residuals.rms_axes, rtol=2e-3)


def test_metrics_come_back_as_they_were(made: Made, tmp_path: Path) -> None:
    """Byte by byte: NaN is not equal to itself."""
    write_metrics(tmp_path / "again.json", read_metrics(made.folder / METRICS_FILE))
    again = (tmp_path / "again.json").read_bytes()
    assert again == (made.folder / METRICS_FILE).read_bytes()
    json.loads(again, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_what_was_just_written_is_reported_without_being_read(
    made: Made, reported: tuple[Level, str], tmp_path: Path
) -> None:
    """The same page as of its folder, which has no bag and no map."""
    shutil.copy(made.folder / CALIBRATION_FILE, tmp_path)
    found = EvaluatedCalibration(read_calibration(made.folder / CALIBRATION_FILE), made.metrics)
    assert report_calibration(tmp_path, found, QaOptions()).level is reported[0]
    assert (tmp_path / REPORT_FILE).read_text() == reported[1]


def test_a_calibration_beside_a_localisation_is_refused(tmp_path: Path) -> None:
    for name in (METRICS_FILE, SLAM_FILE):
        (tmp_path / name).touch()
    with pytest.raises(OutputError, match="one report each"), calibration_results(tmp_path):
        pytest.fail("there can be one report only")


def test_the_page_has_all_that_a_person_looks_for(reported: tuple[Level, str]) -> None:
    page = reported[1]
    assert page.count("<figure>") == 4 + 3 * 8
    for words in (
        "The environment has changed",
        "Scale per axis",
        "Hard iron",
        "° about the axis that is known least",
        "Angles between its axes",
        "What its sigmas rest on",
        "Before, after, map",
        "Repeatability",
        "sha256",
        "gtsam",
        "Thresholds of the verdict",
        "Signature",
    ):
        assert words in page, words


def test_the_page_asks_for_nothing(reported: tuple[Level, str]) -> None:
    """No address but names of XML spaces, no script, and a policy that forbids both."""
    page = reported[1]
    assert "default-src 'none'" in page
    assert "<script" not in page
    addresses = set(re.findall(r"https?://[^\"' <]+", page))
    assert addresses <= {"http://www.w3.org/1999/xlink", "http://www.w3.org/2000/svg"}
    assert set(re.findall(r'(?:src|href)="([^#"][^":]*:)', page)) <= {"data:"}
    names = re.findall(r' id="([^"]+)"', page)
    assert len(names) == len(set(names))
    assert set(re.findall(r'href="#([^"]+)"', page)) <= set(names)
    assert set(re.findall(r"url\(#([^)]+)\)", page)) <= set(names)


@pytest.mark.usefixtures("reported")
def test_a_report_tells_how_far_it_is(made: Made, steps: list[tuple[str, float]]) -> None:
    """A step for each sensor, and the end only once the page is written."""
    assert {stage for stage, _ in steps} == {"report"}
    fractions = [fraction for _, fraction in steps]
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1], fractions.count(1.0)) == (0.0, 1.0, 1)
    assert len(set(fractions)) >= len(made.calibrated.result.sensors) + 2


def test_thresholds_come_from_the_configuration(
    made: Made, reported: tuple[Level, str], tmp_path: Path
) -> None:
    assert reported[0] is Level.WARN
    strict = tmp_path / "strict.yaml"
    strict.write_text("qa: {position_sigma_m: {warn: 1.0e-6, fail: 1.0e-5}}\n")
    assert report_folder(made.folder, strict).judgement.level is Level.FAIL
    assert "1e-05" in (made.folder / REPORT_FILE).read_text()


def scaled(factor: float) -> QaOptions:
    """All limits times a factor."""
    limits = {
        name: Limit(warn=factor * value.warn, fail=factor * value.fail)
        for name, value in QaOptions()
        if isinstance(value, Limit)
    }
    return QaOptions().model_copy(update=limits)


@pytest.mark.parametrize(("less", "more"), [(0.01, 0.1), (0.1, 1.0), (1.0, 3.0), (3.0, 100.0)])
def test_looser_thresholds_never_judge_worse(made: Made, less: float, more: float) -> None:
    strict, loose = (
        judge(made.calibrated.result, made.metrics, scaled(factor)) for factor in (less, more)
    )
    for one, other in zip(strict.sensors, loose.sensors, strict=True):
        assert other.level.rank <= one.level.rank
    assert loose.level.rank <= strict.level.rank


def test_a_stuck_sensor_has_its_place_in_the_report(tmp_path: Path) -> None:
    whole = drive()
    whole = with_series(whole, 1, np.tile([1.0, 2.0, 3.0], (len(EIGHT), 1)))
    found = calibrated(whole.recording, whole.field_map, whole.options)
    metrics = evaluate(whole.recording, found, whole.options, QaOptions(halves=False))
    verdict = write_report(tmp_path, found.result, metrics, QaOptions())
    assert verdict["mag_1"].level is Level.FAIL
    assert "it is stuck" in verdict["mag_1"].reasons[0].text
    page = (tmp_path / REPORT_FILE).read_text()
    assert page.count("<figure>") == 4 + 2 * 7
    assert "were not calibrated by themselves" in page


def test_bad_input_is_one_line(made: Made, tmp_path: Path) -> None:
    assert "calibration.yaml: no such file" in complaint_here("report", tmp_path)
    (tmp_path / CALIBRATION_FILE).write_bytes((made.folder / CALIBRATION_FILE).read_bytes())
    assert "`l2m calibrate` writes it" in complaint_here("report", tmp_path)
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("qa: {rejected: {warn: 0.5, fail: 0.1}}\n")
    assert "fail must not be less than warn" in complaint_here(
        "report", made.folder, "--config", wrong
    )
    wrong.write_text("qa: {nominal: {mag_9: {t_lidar_mag: [0, 0, 0]}}}\n")
    assert "no sensor named 'mag_9'; there are mag_0, mag_1, mag_2" in complaint_here(
        "report", made.folder, "--config", wrong
    )
    wrong.write_text("qa: {nominal: {mag_0: {quaternion_xyzw: [0, 0, 0, 2]}}}\n")
    assert "must have length 1, this one has 2" in complaint_here(
        "report", made.folder, "--config", wrong
    )
    assert not (tmp_path / REPORT_FILE).exists()


def test_without_a_browser_a_pdf_is_one_line(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("L2M_BROWSER", raising=False)
    assert "install chromium" in complaint_here("report", made.folder, "--pdf")
    assert not (made.folder / "report.pdf").exists()


def test_a_browser_that_fails_leaves_no_pdf(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = tmp_path / "chromium"
    browser.write_text("#!/bin/sh\nexit 3\n")
    browser.chmod(0o755)
    monkeypatch.setenv("L2M_BROWSER", str(browser))
    line = complaint_here("report", made.folder, "--pdf")
    assert "could not print report.html (exit code 3)" in line
    assert not (made.folder / "report.pdf").exists()


@pytest.mark.usefixtures("reported")  # judged once already
def test_thresholds_that_remove_a_reason_leave_a_trace(made: Made, tmp_path: Path) -> None:
    """On the page and in the terminal, also where the level stays; halves can be left out."""
    shutil.copytree(made.folder, tmp_path / "made")
    folder, lax = tmp_path / "made", tmp_path / "lax.yaml"
    lax.write_text("qa: {rejected: {warn: 0.9, fail: 0.95}, halves: false}")
    run = l2m("report", folder, "--config", lax)
    page = (folder / REPORT_FILE).read_text()
    assert "by other thresholds" in run.err
    assert "rejected.warn: 0.02 -> 0.9" in run.err
    assert "halves: True -&gt; False" in page
    gone = [line for line in run.err.splitlines() if "no longer a reason" in line]
    assert any("fit neither map nor distortion" in line for line in gone)
    assert "No longer a reason" in page
    assert "Not judged (qa.halves)" in page

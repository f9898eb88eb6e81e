"""Reports on calibrations and localisations."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from l2m_gtsam.batch.drives import (
    CALIBRATION_FILE,
    METRICS_FILE,
    OVERVIEW_FILE,
    EvaluatedCalibration,
)
from l2m_gtsam.batch.files import check_outputs, saved_options
from l2m_gtsam.batch.printing import print_page
from l2m_gtsam.config import Config, load_config
from l2m_gtsam.errors import CalibrationError, OutputError
from l2m_gtsam.progress import Progress, silent
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.calibration_page import STAGE, calibration_page
from l2m_gtsam.qa.report.facts import ENTRIES
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.qa.verdict.calibration import judge, judgement_of
from l2m_gtsam.qa.verdict.mounting import check_names
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.verdict import Judgement, Verdict
from l2m_gtsam.storage.calibration_file import read_calibration, write_calibration
from l2m_gtsam.storage.files import source_file, write_text
from l2m_gtsam.storage.record_files import read_metrics, read_slam, record_id, write_slam
from l2m_gtsam.storage.report_id import SHOWN
from l2m_gtsam.storage.result_set import published

SLAM_FILE = "slam.json"


@dataclass(frozen=True)
class Reported:
    """What a report says: its judgement, and its id."""

    judgement: Judgement
    report_id: str


def report_localisation(folder: Path, config: Path | None, page: Path) -> Reported:
    """Write the report on the localisation in a folder, and its verdict if that is another.

    Parameters
    ----------
    folder
        Where it was written to.
    config
        Configuration with thresholds; those that it was judged by if there is none.
    page
        File of the report.

    Raises
    ------
    L2MError
        The record is missing or damaged; one line.
    """
    # Reports on calibrations, which are more frequent, start sooner without.
    from l2m_gtsam.qa.verdict.localisation import judgement_of_localisation

    source = folder / SLAM_FILE
    found = read_slam(source)
    options = _limits(source, found, None if config is None else load_config(config))
    judgement = judgement_of_localisation(found, options)
    record = replace(found, judgement=judgement)
    with published(folder, adds=True) as stage:
        if judgement != found.judgement:
            source = stage / SLAM_FILE
            write_slam(source, record)
        identity = Identity(record_id(source), source_file(source))
        write_slam_report(stage / page.name, record, options, identity)
    return Reported(judgement, identity.id)


def write_slam_report(
    page: Path, record: LocalisationRecord, options: QaOptions, identity: Identity
) -> None:
    """Write the report on a localisation, which has an identity."""
    from l2m_gtsam.qa.report.localisation_page import localisation_page

    text = localisation_page(record, options, identity)
    with published(page.parent, page.name, adds=True) as stage:
        write_text(stage / page.name, text)


REPORT_FILE = "report.html"
PDF_FILE = "report.pdf"
OUTCOME_FILE = "outcome.json"


def report_folder(
    folder: Path, config: Path | None, progress: Progress = silent, *, pdf: bool = False
) -> Reported:
    """Write `report.html` from what is in a folder, and into the result what it was judged.

    Parameters
    ----------
    folder
        Where a calibration (`calibration.yaml` and `metrics.json`) or a localisation (`slam.json`)
        was written to.
    config
        Configuration with thresholds; those that it was judged by if there is none.
    progress
        Called with a stage and the fraction of it that is done.
    pdf
        Whether `report.pdf` is written, too.

    Raises
    ------
    L2MError
        A file is missing or damaged, or there is no browser to print with; one line.
    """
    progress(STAGE, 0.0)
    check_outputs(folder / REPORT_FILE, folder / PDF_FILE)
    if holds_localisation(folder):
        reported = report_localisation(folder, config, folder / REPORT_FILE)
    else:
        reported = _report_calibration(folder, config, progress)
    if pdf:
        print_page(folder / REPORT_FILE, folder / PDF_FILE)
    progress(STAGE, 1.0)
    return reported


@contextmanager
def calibration_results(out: Path) -> Iterator[Path]:
    """Give a hidden folder for a calibration and its report, which are published together.

    The outcome of a drive of a fleet may be among them; it goes where there is a new calibration.

    Parameters
    ----------
    out
        Where they are to be.

    Raises
    ------
    OutputError
        They cannot be written, or the folder holds a localisation.
    """
    names = (CALIBRATION_FILE, OVERVIEW_FILE, METRICS_FILE, REPORT_FILE, PDF_FILE, OUTCOME_FILE)
    check_outputs(*(out / name for name in names))
    if holds_localisation(out):
        raise OutputError(
            f"{out}: holds a localisation, whose report would be lost; choose another --out"
        )
    with published(out, *names, unlisted=(OUTCOME_FILE,)) as stage:
        yield stage


def report_calibration(
    folder: Path, found: EvaluatedCalibration, options: QaOptions, progress: Progress = silent
) -> Verdict:
    """Write `report.html` on what was just written to a folder, as `report_folder` would.

    Parameters
    ----------
    folder
        Where the calibration was written to.
    found
        The calibration and its figures.
    options
        Thresholds.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        The report cannot be written; one line.
    """
    progress(STAGE, 0.0)
    identity = Identity(found.result.report_id, source_file(folder / CALIBRATION_FILE))
    verdict = write_report(folder, found.result, found.metrics, options, progress, identity)
    progress(STAGE, 1.0)
    return verdict


def holds_localisation(folder: Path) -> bool:
    """Return whether a report on a folder is one on a localisation.

    Raises
    ------
    OutputError
        It holds a calibration, too: there can be one report only.
    """
    if not (folder / SLAM_FILE).exists():
        return False
    if (folder / METRICS_FILE).exists():
        raise OutputError(
            f"{folder}: holds a calibration ({METRICS_FILE}) and a localisation ({SLAM_FILE}), "
            "which have one report each; move one of them to a folder of its own"
        )
    return True


def _report_calibration(folder: Path, config: Path | None, progress: Progress) -> Reported:
    source = folder / CALIBRATION_FILE
    if not source.exists():
        raise CalibrationError(
            f"{source}: no such file; give a folder that `l2m calibrate` or `l2m slam` wrote to"
        )
    found = read = read_calibration(source)
    metrics = read_metrics(folder / METRICS_FILE)
    digest = source_file(folder / METRICS_FILE).sha256
    if found.metrics_sha256 not in ("", digest):
        raise CalibrationError(
            f"{folder / METRICS_FILE}: is not the file that {CALIBRATION_FILE} was written with "
            f"(report {found.report_id[:SHOWN]}), or was changed; restore it, or calibrate again"
        )
    given = None if config is None else load_config(config)
    options = _limits(source, found, given)
    if given is not None and given.report:
        found = replace(found, options={**found.options, ENTRIES: given.report})
    check_names([each.sensor for each in found.sensors], options)
    judgement = judgement_of(found, metrics, options)
    result = replace(found, judgement=judgement, metrics_sha256=digest)
    with published(folder, adds=True) as stage:
        if judgement != found.judgement or found.options != read.options:
            source = stage / CALIBRATION_FILE
            result = write_calibration(source, result)
        identity = Identity(result.report_id, source_file(source))
        write_report(stage, result, metrics, options, progress, identity)
    return Reported(judgement, identity.id)


def write_report(
    folder: Path,
    result: CalibrationResult,
    metrics: Metrics,
    options: QaOptions,
    progress: Progress = silent,
    identity: Identity | None = None,
) -> Verdict:
    """Write the report on a calibration and return its verdict; parameters as of the page.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    page = calibration_page(result, metrics, options, progress, identity)
    with published(folder, REPORT_FILE, adds=True) as stage:
        write_text(stage / REPORT_FILE, page)
    return judge(result, metrics, options)


def _limits(
    source: Path, found: CalibrationResult | LocalisationRecord, given: Config | None
) -> QaOptions:
    """Return the thresholds given, else those that a result was judged by, or was made with."""
    if given is not None:
        return given.qa
    if found.judgement is not None:
        return saved_options(source, found.judgement.thresholds, QaOptions)
    return saved_options(source, found.options, QaOptions, "qa")

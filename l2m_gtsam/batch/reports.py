"""Reports: rendered from what a calibration or a localisation left behind."""

from pathlib import Path

from pydantic import ValidationError

from l2m_gtsam.batch.drives import CALIBRATION_FILE, METRICS_FILE, Appraised
from l2m_gtsam.batch.outputs import check_outputs
from l2m_gtsam.batch.slam_report import SLAM_FILE, report_localisation
from l2m_gtsam.config import load_config
from l2m_gtsam.errors import ConfigError, OutputError
from l2m_gtsam.metric_results import Metrics
from l2m_gtsam.progress import Progress
from l2m_gtsam.qa.judge import Verdict, judge
from l2m_gtsam.qa.nominal import check_names
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.page import STAGE, report_page
from l2m_gtsam.results import CalibrationResult
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.metrics_file import read_metrics
from l2m_gtsam.storage.pdf import print_page

REPORT_FILE = "report.html"
PDF_FILE = "report.pdf"


def report_folder(
    folder: Path, config: Path | None, progress: Progress | None = None, *, pdf: bool = False
) -> Verdict:
    """Write `report.html` from what is in a folder.

    Parameters
    ----------
    folder
        Where a calibration (`calibration.yaml` and `metrics.json`) or a localisation (`slam.json`)
        was written to.
    config
        Configuration with thresholds; those that it was computed with if there is none.
    progress
        Called with a stage and the fraction of it that is done.
    pdf
        Whether `report.pdf` is written, too.

    Raises
    ------
    L2MError
        A file is missing or damaged, or there is no browser to print with; one line.
    """
    tell = progress or (lambda stage, fraction: None)
    tell(STAGE, 0.0)
    check_outputs(folder / REPORT_FILE, folder / PDF_FILE)
    if holds_localisation(folder):
        verdict = report_localisation(folder, config, folder / REPORT_FILE)
    else:
        verdict = _report_calibration(folder, config, tell)
    if pdf:
        print_page(folder / REPORT_FILE, folder / PDF_FILE)
    tell(STAGE, 1.0)
    return verdict


def report_calibration(
    folder: Path, found: Appraised, options: QaOptions, progress: Progress | None = None
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
        The report cannot be written, or the folder holds a localisation, too; one line.
    """
    tell = progress or (lambda stage, fraction: None)
    tell(STAGE, 0.0)
    check_outputs(folder / REPORT_FILE)
    holds_localisation(folder)
    verdict = write_report(folder, found.result, found.metrics, options, tell)
    tell(STAGE, 1.0)
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


def _report_calibration(folder: Path, config: Path | None, progress: Progress) -> Verdict:
    result = read_calibration(folder / CALIBRATION_FILE)
    metrics = read_metrics(folder / METRICS_FILE)
    options = _saved(result) if config is None else load_config(config).qa
    return write_report(folder, result, metrics, options, progress)


def write_report(
    folder: Path,
    result: CalibrationResult,
    metrics: Metrics,
    options: QaOptions,
    progress: Progress | None = None,
) -> Verdict:
    """Write the report on a calibration and return its verdict.

    Raises
    ------
    ConfigError
        The options name a sensor that is not there.
    OutputError
        It cannot be written.
    """
    check_names([each.sensor for each in result.sensors], options)
    page = report_page(result, metrics, options, progress)
    with atomic_path(folder / REPORT_FILE) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")
    return judge(result, metrics, options)


def _saved(result: CalibrationResult) -> QaOptions:
    """Return the thresholds that a calibration was made with."""
    try:
        return QaOptions.model_validate(result.options.get("qa", {}))
    except ValidationError as error:
        fault = error.errors()[0]
        key = ".".join(str(part) for part in ("qa", *fault["loc"]))
        msg = f"{CALIBRATION_FILE}: options: {key}: {fault['msg']}; give thresholds with --config"
        raise ConfigError(msg) from error

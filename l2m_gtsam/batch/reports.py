"""Reports: rendered from what a calibration left behind."""

from pathlib import Path

from pydantic import ValidationError

from l2m_gtsam.batch.drives import CALIBRATION_FILE, METRICS_FILE
from l2m_gtsam.batch.outputs import check_outputs
from l2m_gtsam.config import load_config
from l2m_gtsam.errors import ConfigError
from l2m_gtsam.metric_results import Metrics
from l2m_gtsam.qa.judge import Verdict, judge
from l2m_gtsam.qa.nominal import check_names
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.page import report_page
from l2m_gtsam.results import CalibrationResult
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.calibration_file import read_calibration
from l2m_gtsam.storage.metrics_file import read_metrics
from l2m_gtsam.storage.pdf import print_page

REPORT_FILE = "report.html"
PDF_FILE = "report.pdf"


def report_folder(folder: Path, config: Path | None, *, pdf: bool = False) -> Verdict:
    """Write `report.html` from `calibration.yaml` and `metrics.json` in a folder.

    Parameters
    ----------
    folder
        Where a calibration was written to.
    config
        Configuration with thresholds; those of the calibration if there is none.
    pdf
        Whether `report.pdf` is written, too.

    Raises
    ------
    L2MError
        A file is missing or damaged, or there is no browser to print with; one line.
    """
    check_outputs(folder / REPORT_FILE, folder / PDF_FILE)
    result = read_calibration(folder / CALIBRATION_FILE)
    metrics = read_metrics(folder / METRICS_FILE)
    options = _saved(result) if config is None else load_config(config).qa
    verdict = write_report(folder, result, metrics, options)
    if pdf:
        print_page(folder / REPORT_FILE, folder / PDF_FILE)
    return verdict


def write_report(
    folder: Path, result: CalibrationResult, metrics: Metrics, options: QaOptions
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
    page = report_page(result, metrics, options)
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

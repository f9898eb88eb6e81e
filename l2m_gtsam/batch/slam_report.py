"""The report on a localisation, rendered from `slam.json`."""

from pathlib import Path

from l2m_gtsam.batch.corrections import saved_options
from l2m_gtsam.config import load_config
from l2m_gtsam.qa.judge import Verdict
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.slam_page import slam_page
from l2m_gtsam.qa.slam.judge import judge_localisation
from l2m_gtsam.records.localisation_file import LocalisationRecord
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.storage.record_files import read_slam

SLAM_FILE = "slam.json"


def report_localisation(folder: Path, config: Path | None, page: Path) -> Verdict:
    """Write the report on the localisation in a folder.

    Parameters
    ----------
    folder
        Where it was written to.
    config
        Configuration with thresholds; those of the localisation if there is none.
    page
        File of the report.

    Raises
    ------
    L2MError
        The record is missing or damaged; one line.
    """
    source = folder / SLAM_FILE
    record = read_slam(source)
    if config is None:
        options = saved_options(source, record.options, QaOptions, "qa")
    else:
        options = load_config(config).qa
    return write_slam_report(page, record, options)


def write_slam_report(page: Path, record: LocalisationRecord, options: QaOptions) -> Verdict:
    """Write the report on a localisation and return its verdict."""
    text = slam_page(record, options)
    with atomic_path(page) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="replace")
    return judge_localisation(record, options)

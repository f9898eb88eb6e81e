"""Mapping suites calibrated from their own drives: from files to a file."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from l2m_gtsam.batch.opening import check_bags, read_drive
from l2m_gtsam.batch.outputs import check_outputs, ensure_folder
from l2m_gtsam.config import Config
from l2m_gtsam.mapping.suite_calibration import calibrate_suite
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.known_sensors import read_known_sensors


def calibrate_suite_file(
    bags: Sequence[Path],
    out: Path,
    config: Config,
    known: Path | None,
    progress: Progress,
) -> CalibrationResult:
    """Calibrate the sensors of mapping bags and write the calibration.

    Parameters
    ----------
    bags
        One or several mapping bags of one suite.
    out
        Calibration to write (`.yaml`).
    config
        Configuration.
    known
        File with what is known of the sensors, if there is one.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    check_bags(bags)
    check_outputs(out, suffix=".yaml")
    assumed = None if known is None else read_known_sensors(known)
    recordings = [read_drive(bag, config, progress) for bag in bags]
    found = calibrate_suite(recordings, assumed, config.mapping.suite, progress)
    result = replace(found, options=config.model_dump(mode="json", include={"bag", "mapping"}))
    ensure_folder(out.parent)
    write_calibration(out, result)
    return result

"""Calibrations tested on other drives, and beside older ones."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l2m_gtsam.batch.files import SavedMap, check_outputs, saved_options
from l2m_gtsam.batch.scan_poses import read_drive_on
from l2m_gtsam.batch.software import versions
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.config import Config, load_config, with_poses
from l2m_gtsam.errors import CalibrationError, ConfigError
from l2m_gtsam.progress import Progress
from l2m_gtsam.qa.metrics.changes import compare_calibrations, is_calibrated
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.page import Identity
from l2m_gtsam.qa.report.validation_page import validation_page
from l2m_gtsam.qa.verdict.validation import judge_validation, validation_thresholds
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.provenance import NamedSource
from l2m_gtsam.records.validation import CalibrationComparison, DriveValidation, Validation
from l2m_gtsam.storage.bag_options import BagOptions, PoseFileOptions
from l2m_gtsam.storage.files import source_file, write_text
from l2m_gtsam.storage.listed_sensors import read_sensors
from l2m_gtsam.storage.record_files import write_validation
from l2m_gtsam.storage.result_set import published
from l2m_gtsam.validation.validate import validate

VALIDATION_FILE = "validation.json"
PAGE_FILE = "validation.html"
ROUNDING = 1e-6  # of the largest variance: what a covariance may be below zero


@dataclass(frozen=True)
class ValidationRequest:
    """What is asked for.

    Attributes
    ----------
    calibration
        The `calibration.yaml` to be tested.
    bag, map_path
        A drive and a map to test it on; both or none.
    compare
        An older `calibration.yaml` to compare it with.
    config
        Configuration; what the calibration was computed with if absent.
    out
        Folder for `validation.json` and `validation.html`; nothing is written without.
    poses, pose_times
        File with the poses of the drive, if they are not in it, and KITTI's times.
    """

    calibration: Path
    bag: Path | None = None
    map_path: Path | None = None
    compare: Path | None = None
    config: Path | None = None
    out: Path | None = None
    poses: tuple[Path, ...] = ()
    pose_times: Path | None = None


def validate_calibration(asked: ValidationRequest, progress: Progress) -> Validation:
    """Test a calibration on a drive, or beside an older one, or both.

    Parameters
    ----------
    asked
        Files.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    _check_request(asked)
    new = read_sound_calibration(asked.calibration)
    drives = [] if asked.bag is None else [asked.bag]
    config = with_poses(_config(asked, new), drives, asked.poses, asked.pose_times)
    sources = [_source("calibration", asked.calibration)]
    drive, comparison = None, None
    if asked.compare is not None:
        comparison = _compared(asked, asked.compare, new, config.qa)
        sources.append(_source("old calibration", asked.compare))
    if asked.bag is not None and asked.map_path is not None:
        drive = _tested(asked.bag, asked.map_path, new, config, progress)
        sources += [_source("drive", asked.bag), _source("map", asked.map_path)]
    found = Validation(
        verdict=judge_validation(drive, comparison, config.qa),
        drive=drive,
        comparison=comparison,
        thresholds=validation_thresholds(config.qa),
        sources=tuple(sources),
        versions=versions(),
    )
    if asked.out is not None:
        _write(asked.out, found)
    return found


def _check_request(asked: ValidationRequest) -> None:
    """Raise a ConfigError for files that do not go together."""
    if asked.bag is None and asked.map_path is not None:
        raise ConfigError("--map: goes with a BAG; say which drive is compared with it")
    if asked.bag is not None and asked.map_path is None:
        raise ConfigError(f"{asked.bag}: needs --map, a map of the place, to be compared with")
    if asked.bag is None and asked.compare is None:
        raise ConfigError("nothing to validate against: give a BAG with --map, or --compare")
    if asked.out is not None:
        check_outputs(asked.out / VALIDATION_FILE, asked.out / PAGE_FILE)


def read_sound_calibration(path: Path) -> CalibrationResult:
    """Return a calibration whose numbers can be computed with.

    Raises
    ------
    CalibrationError
        The file is missing or damaged, lists no sensor, or has a covariance that is none.
    """
    result = read_sensors(path)
    if not any(map(is_calibrated, result.sensors)):
        raise CalibrationError(f"{path}: none of its sensors is calibrated; nothing to validate")
    for sensor in filter(is_calibrated, result.sensors):
        if fault := _unsound(sensor):
            raise CalibrationError(f"{path}: sensors.{sensor.sensor}.{fault}; calibrate again")
    return result


def _unsound(sensor: SensorCalibration) -> str:
    """Return which number of a sensor cannot be computed with; nothing if all can."""
    matrices = {"covariance": sensor.covariance, "rotation_covariance": sensor.rotation_covariance}
    for name, matrix in matrices.items():
        variances = np.diag(matrix)
        known = np.isfinite(variances)
        part = matrix[np.ix_(known, known)]
        if np.isnan(variances).any() or not np.isfinite(part).all() or (variances <= 0).any():
            return f"{name}: variances must be positive, or infinite for what is not determined"
        scaled = part / np.sqrt(np.outer(variances[known], variances[known]))
        if len(part) and (
            np.abs(scaled - scaled.T).max() > ROUNDING
            or np.linalg.eigvalsh(scaled)[0] < -ROUNDING * len(part)
        ):
            return f"{name}: is no covariance matrix, it must be symmetric and not negative"
    if not (np.isfinite(sensor.noise) and sensor.noise > 0):
        return "noise: must be positive"
    offset = sensor.time_offset
    if offset is None:
        return ""
    sigma = offset.sigma if offset.estimated else 0.0
    numbers = [offset.seconds, sigma, *offset.cross_covariance]
    return "" if np.isfinite(numbers).all() else "time_offset: must be finite"


def _config(asked: ValidationRequest, new: CalibrationResult) -> Config:
    """Return the configuration that is given, or the parts that the calibration was made with."""
    if asked.config is not None:
        return load_config(asked.config)
    path, options = asked.calibration, new.options
    bag = saved_options(path, options, BagOptions, "bag")
    # Poses in a file are those of the old drive.
    bag = bag.model_copy(update={"pose_file": PoseFileOptions()})
    return Config(
        bag=bag,
        calibration=saved_options(path, options, CalibrationOptions, "calibration"),
        qa=saved_options(path, options, QaOptions, "qa"),
    )


def _compared(
    asked: ValidationRequest, old_path: Path, new: CalibrationResult, options: QaOptions
) -> CalibrationComparison:
    old = read_sound_calibration(old_path)
    found = compare_calibrations(new, old, options.validation.chance)
    if not found.sensors:
        names = [", ".join(each.sensor for each in result.sensors) for result in (new, old)]
        raise CalibrationError(
            f"{old_path}: no sensor that both calibrations know: there are {names[1]}, in "
            f"{asked.calibration} there are {names[0]}"
        )
    return found


def _tested(
    bag: Path, map_path: Path, new: CalibrationResult, config: Config, progress: Progress
) -> DriveValidation:
    saved = SavedMap.read(map_path)
    recording = read_drive_on(saved, bag, config, progress)
    field_map = saved.open(progress, [recording])
    source, chance = source_file(map_path), config.qa.validation.chance
    found = validate(recording, field_map, new, config.calibration, chance, source, progress)
    return replace(
        found, doubts=(*found.doubts, *(f"Of the map: {each}." for each in saved.doubts))
    )


def _source(role: str, path: Path) -> NamedSource:
    return NamedSource(role, **vars(source_file(path)))


def _write(folder: Path, found: Validation) -> None:
    with published(folder, VALIDATION_FILE, PAGE_FILE) as stage:
        written = write_validation(stage / VALIDATION_FILE, found)
        page = validation_page(found, Identity(written, source_file(stage / VALIDATION_FILE)))
        write_text(stage / PAGE_FILE, page)

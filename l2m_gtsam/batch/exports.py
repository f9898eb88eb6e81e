"""Calibrations for other programs: written in their formats, and applied to bags."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from l2m_gtsam.batch.files import check_not_replaced, check_outputs, saved_options
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.config import Config, load_config
from l2m_gtsam.data import CorrectedField, FloatArray, IntArray, ScalarSeries
from l2m_gtsam.errors import BagError, CalibrationError, ConfigError
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.recording.regressors import ResampleOptions, resampled
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.verdict import NOT_JUDGED, Level, Verdict
from l2m_gtsam.solve.correction import corrected, moving_variance, without_moving
from l2m_gtsam.storage.bag_copy import bag_copy, check_copy
from l2m_gtsam.storage.bag_options import BagOptions
from l2m_gtsam.storage.bounded import read_content
from l2m_gtsam.storage.calibrated_topics import (
    Calibrator,
    Correct,
    Key,
    SensorTopic,
    check_units,
    sensor_topics,
)
from l2m_gtsam.storage.calibration_file import verdict_text
from l2m_gtsam.storage.exports.export import (
    Export,
    check_lidar_frame,
    export_of,
    left_out_notes,
    not_correctable,
    usable_sensors,
)
from l2m_gtsam.storage.exports.formats import FORMATS
from l2m_gtsam.storage.exports.urdf import edited_urdf
from l2m_gtsam.storage.files import atomic_path, ensure_folder, source_file
from l2m_gtsam.storage.listed_sensors import read_sensors
from l2m_gtsam.storage.open_bag import Bag, open_bag
from l2m_gtsam.storage.regressors import read_scalars

MAX_URDF_BYTES = 20_000_000  # those of vehicles are under one


@dataclass(frozen=True)
class Names:
    """What frames are called outside.

    Attributes
    ----------
    lidar
        The lidar's frame.
    sensors
        Frames of sensors that are not called like their sensor.
    """

    lidar: str = "lidar"
    sensors: Mapping[str, str] = field(default_factory=dict)


def verdict_notes(path: Path, result: CalibrationResult, despite_verdict: bool) -> tuple[str, ...]:
    """Return what is worth a warning of the verdict on a calibration, a sentence each.

    Parameters
    ----------
    despite_verdict
        Whether a FAIL is to be used all the same.

    Raises
    ------
    CalibrationError
        It was judged FAIL, and is not to be used despite that.
    """
    if result.judgement is None:
        return (f"{path}: {NOT_JUDGED}; it holds no verdict",)
    verdict = result.judgement.verdict
    if verdict.level is Level.PASS:
        return tuple(f"{path}: {each}" for each in result.judgement.before())
    warning = f"{path}: its verdict is {verdict.level.upper()}: {_worst_reason(verdict)}"
    if verdict.level is Level.FAIL and not despite_verdict:
        raise CalibrationError(f"{warning}; to use it all the same, give --despite-verdict")
    return (warning,)


def _worst_reason(verdict: Verdict) -> str:
    """Return the first of the reasons that make a verdict what it is, and how many more."""
    worst = [each for each in verdict.warnings if each.level is verdict.level]
    if not worst:
        return "it gives no reason"
    more = f" (and {len(worst) - 1} more)" if len(worst) > 1 else ""
    of_sensor = f"{worst[0].sensor}: " if worst[0].sensor else ""
    return f"{of_sensor}{worst[0].text.rstrip('.')}{more}"


def export_calibration(
    calibration: Path,
    format_name: str,
    out: Path,
    names: Names,
    into: Path | None = None,
    *,
    despite_verdict: bool = False,
) -> tuple[str, ...]:
    """Write a calibration for another program.

    Parameters
    ----------
    calibration
        A `calibration.yaml`.
    format_name
        One of ``FORMATS``.
    out
        File to write; the folder is made if it is missing.
    names
        Of frames.
    into
        A URDF that the sensors are put into; it stays as it is, the copy is written.
    despite_verdict
        Whether a calibration that was judged FAIL is written all the same.

    Returns
    -------
    What is worth a warning: sensors that are left out, what a format loses.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    if format_name not in FORMATS:
        accepted = ", ".join(FORMATS)
        raise ConfigError(f"--format: unknown format {format_name!r}; accepted: {accepted}")
    if into is not None and format_name != "urdf":
        raise ConfigError("--into: goes with --format urdf alone")
    check_outputs(out)
    check_not_replaced(out, calibration, into)
    chosen, result = FORMATS[format_name], read_sensors(calibration)
    judged = verdict_notes(calibration, result, despite_verdict)
    export = export_of(result, chosen.fault, names.lidar, names.sensors)
    content = chosen.text(export).encode() if into is None else _edited(export, into)
    ensure_folder(out.parent)
    with atomic_path(out) as temporary:
        temporary.write_bytes(content)
    return (*judged, *left_out_notes(export.left_out), *chosen.notes(export))


def _edited(export: Export, urdf: Path) -> bytes:
    return edited_urdf(export, str(urdf), read_content(urdf, MAX_URDF_BYTES, ConfigError))


def not_applicable(sensor: SensorCalibration) -> str | None:
    """Return why the readings of a sensor cannot be corrected."""
    if (reason := not_correctable(sensor)) is not None:
        return reason
    unknown = [m.name for m in sensor.moving if not np.isfinite([m.h, m.sigma]).all()]
    return f"what follows {unknown[0]} is not determined" if unknown else None


def corrections_of(
    bag: Path, sensors: Sequence[SensorCalibration], config: Config, progress: Progress
) -> dict[str, Correct]:
    """Return what corrects sensors of a bag, by their names.

    Parameters
    ----------
    bag
        The bag; numbers that readings follow are read out of it.
    sensors
        Sensors whose readings can be corrected.
    config
        How the bag is read.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    ConfigError
        A number that readings follow is not named.
    BagError
        It is not in the bag.
    """
    own = config.bag
    names = sorted({moving.name for sensor in sensors for moving in sensor.moving})
    if missing := [name for name in names if name not in own.regressors]:
        raise ConfigError(
            f"a part of the readings follows {missing[0]!r}, which `bag.regressors` does not name; "
            "say in --config where it is recorded"
        )
    asked = {"regressors": {name: own.regressors[name] for name in names}}
    count = counter(f"reading numbers of {bag.name}", progress)
    scalars = read_scalars(bag, own.model_copy(update=asked), count)
    series, resampling = {each.name: each for each in scalars}, config.calibration.regressors
    return {
        sensor.sensor: _correction(sensor, [series[m.name] for m in sensor.moving], resampling)
        for sensor in sensors
    }


def _correction(
    sensor: SensorCalibration, numbers: Sequence[ScalarSeries], resampling: ResampleOptions
) -> Correct:
    """Return what takes a sensor's moving fields out of its readings, and then C and H."""
    covariance = np.array(sensor.covariance[3:, 3:])
    h = np.array([moving.h for moving in sensor.moving]).reshape(-1, 3)
    h_sigma = np.array([moving.sigma for moving in sensor.moving]).reshape(-1, 3)

    def correct(readings: FloatArray, stamp_ns: IntArray) -> CorrectedField:
        at = resampled(numbers, stamp_ns, resampling)
        still = without_moving(readings, at.values, h)
        still[~at.known] = np.nan
        variance = sensor.noise**2 + moving_variance(at.values, h_sigma)
        return corrected(still, sensor.distortion, covariance, variance)

    return correct


@dataclass(frozen=True)
class Application:
    """What is asked for.

    Attributes
    ----------
    bag
        Bag with the readings.
    calibration
        A `calibration.yaml`.
    out
        Bag to write, of the same kind.
    config
        Configuration whose `bag` says how readings are read; that of the calibration if absent.
    lidar_frame
        Name of the frame that the corrected readings are in.
    replace
        Whether the topics that are corrected are left out.
    despite_verdict
        Whether a calibration that was judged FAIL is applied all the same.
    """

    bag: Path
    calibration: Path
    out: Path
    config: Path | None = None
    lidar_frame: str = "lidar"
    replace: bool = False
    despite_verdict: bool = False


@dataclass(frozen=True)
class Applied:
    """What was done.

    Attributes
    ----------
    topics
        Topics of the corrected readings by the names of the sensors.
    notes
        What is worth a warning, a sentence each.
    """

    topics: Mapping[str, str]
    notes: tuple[str, ...]


def apply_calibration(wanted: Application, progress: Progress) -> Applied:
    """Write a copy of a bag with corrected readings, along the axes of the lidar.

    Parameters
    ----------
    wanted
        What to write, and from what.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    result = read_sensors(wanted.calibration)
    judged = verdict_notes(wanted.calibration, result, wanted.despite_verdict)
    config = _config(wanted, result)
    usable = usable_sensors(result, not_applicable)
    check_lidar_frame(wanted.lidar_frame)
    with open_bag(wanted.bag) as bag:
        check_copy(bag, wanted.out)
        name = wanted.bag.name
        found = sensor_topics(bag, config.bag, counter(f"reading {name}", progress))
        names = {each.sensor for each in found.values()}
        here = [sensor for sensor in usable.sensors if sensor.sensor in names]
        corrections = corrections_of(wanted.bag, here, config, progress)
        topics = _calibrated_topics(bag, found, corrections, config.bag)
        left_out = frozenset(topic for topic, _ in topics) if wanted.replace else frozenset()
        calibrator = Calibrator(
            bag=bag,
            topics=topics,
            corrections=corrections,
            options=config.bag,
            frame=wanted.lidar_frame,
            left_out=left_out,
            verdict=verdict_text(result, source_file(wanted.calibration)),
        )
        with bag_copy(bag, wanted.out) as copy:
            calibrator.copy(copy, counter(f"copying {name}", progress))
    added = {new.sensor: new.topic for new in topics.values()}
    return Applied(added, (*judged, *left_out_notes(usable.left_out), *_unmatched(result, found)))


def _config(wanted: Application, result: CalibrationResult) -> Config:
    """Return the configuration that is given, or how the drive of the calibration was read."""
    if wanted.config is not None:
        return load_config(wanted.config)
    path, options = wanted.calibration, result.options
    bag = saved_options(path, options, BagOptions, "bag")
    resampling = saved_options(path, options, ResampleOptions, "calibration", "regressors")
    return Config(bag=bag, calibration=CalibrationOptions(regressors=resampling))


def _calibrated_topics(
    bag: Bag,
    found: Mapping[Key, SensorTopic],
    corrections: Mapping[str, Correct],
    options: BagOptions,
) -> dict[Key, SensorTopic]:
    """Return what is added for each sensor of the bag that is calibrated."""
    topics = {key: each for key, each in found.items() if each.sensor in corrections}
    if not topics:
        there = ", ".join(sorted(each.sensor for each in found.values()))
        raise BagError(
            f"{bag.path}: the calibration can correct none of its sensors "
            f"({there or 'no readings'})"
        )
    taken = {connection.topic for connection in bag.connections}
    for key, each in topics.items():
        if each.topic in taken:
            raise BagError(f"{bag.path}: has a topic {each.topic} already")
        check_units(bag, key, each, options)
    return topics


def _unmatched(result: CalibrationResult, found: Mapping[Key, SensorTopic]) -> tuple[str, ...]:
    """Return which sensors are in the calibration alone or in the bag alone, a sentence each."""
    calibrated = [sensor.sensor for sensor in result.sensors]
    there = [each.sensor for each in found.values()]
    return (
        *(f"{name} is not in the bag" for name in calibrated if name not in there),
        *(f"{name} is not in the calibration" for name in sorted(there) if name not in calibrated),
    )

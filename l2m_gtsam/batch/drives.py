"""Drives: inspected, calibrated and planned."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from l2m_gtsam.batch.files import OpenMap, SavedMap, check_bags, check_outputs, read_drive
from l2m_gtsam.batch.scan_poses import read_drives_on
from l2m_gtsam.batch.software import versions
from l2m_gtsam.calibration.calibrate import calibrated
from l2m_gtsam.config import Config
from l2m_gtsam.data import KnownSensor, Recording
from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.qa.evaluate import FIGURES, evaluate
from l2m_gtsam.qa.report.figures.vehicle import calibration_figure
from l2m_gtsam.qa.report.svg import save_figure
from l2m_gtsam.qa.verdict.calibration import judgement_of
from l2m_gtsam.qa.verdict.mounting import check_names
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.plan import DrivePlan
from l2m_gtsam.storage.bag import has_fields, read_trajectory
from l2m_gtsam.storage.calibration_file import write_calibration
from l2m_gtsam.storage.files import ensure_folder, source_file
from l2m_gtsam.storage.inspect import BagReport, inspect_bag
from l2m_gtsam.storage.record_files import write_metrics
from l2m_gtsam.storage.rerun_file import require_rerun, write_scene
from l2m_gtsam.storage.result_set import published

CALIBRATION_FILE = "calibration.yaml"
OVERVIEW_FILE = "overview.png"
METRICS_FILE = "metrics.json"


@dataclass(frozen=True)
class EvaluatedCalibration:
    """A calibration that was written, and the figures that it is judged by."""

    result: CalibrationResult
    metrics: Metrics


def inspect_file(bag: Path, config: Config, progress: Progress) -> BagReport:
    """Return what is in a bag and what would be used of it."""
    return inspect_bag(bag, config.bag, counter(f"reading {bag.name}", progress))


def calibrate_bags(
    bags: Sequence[Path],
    map_path: Path,
    config: Config,
    out: Path,
    progress: Progress,
    truth: tuple[KnownSensor, ...] = (),
    view: Path | None = None,
) -> EvaluatedCalibration:
    """Calibrate all magnetometers; write `calibration.yaml`, metrics and a picture.

    Parameters
    ----------
    bags
        Drives of one vehicle through the mapped place, which are calibrated together.
    out
        Folder for the results, made if it is missing.
    progress
        Called with a stage and the fraction of it that is done.
    truth
        Sensors as they are, if that is known, to be drawn beside the estimate.
    view
        File for a three-dimensional view (.rrd), if one is wanted.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line; nothing is written then.
    """
    check_bags(bags)
    check_outputs(*(out / name for name in (CALIBRATION_FILE, OVERVIEW_FILE, METRICS_FILE)))
    if view is not None:
        require_rerun(view)
        check_outputs(view)
    saved = SavedMap.read(map_path)
    recording = read_drives_on(saved, bags, config, progress)
    opened = OpenMap.of(saved, progress, recording.parts)
    return calibrate_drive(recording, opened, config, out, progress, truth, view)


def calibrate_drive(
    recording: Recording,
    opened: OpenMap,
    config: Config,
    out: Path,
    progress: Progress,
    truth: tuple[KnownSensor, ...] = (),
    view: Path | None = None,
) -> EvaluatedCalibration:
    """Calibrate a drive that was read, on a map that is open; the rest is as `calibrate_bags`."""
    check_names([each.sensor for each in recording.series], config.qa)
    found = calibrated(recording, opened.field_map, config.calibration, opened.source, progress)
    metrics = evaluate(recording, found, config.calibration, config.qa, progress)
    doubts = (*found.result.doubts, *opened.saved.doubts)
    unjudged = replace(
        found.result,
        options=config.model_dump(mode="json"),
        doubts=doubts,
        map_origin=opened.origin,
        versions=versions(),
    )
    result = replace(unjudged, judgement=judgement_of(unjudged, metrics, config.qa))
    drives = [each.trajectory for each in recording.parts]
    figure = calibration_figure(metrics.map, drives, result, truth)
    with published(out, CALIBRATION_FILE, METRICS_FILE, OVERVIEW_FILE) as stage:
        write_metrics(stage / METRICS_FILE, metrics)
        result = replace(result, metrics_sha256=source_file(stage / METRICS_FILE).sha256)
        result = write_calibration(stage / CALIBRATION_FILE, result)
        save_figure(figure, stage / OVERVIEW_FILE)
    progress(FIGURES, 1.0)
    if view is not None:
        from l2m_gtsam.qa.scene import scene_of

        ensure_folder(view.parent)
        write_scene(view, scene_of(recording, found))
    return EvaluatedCalibration(result, metrics)


def plan_bag(
    bag: Path,
    map_path: Path,
    config: Config,
    at: Sequence[tuple[float, float, float]],
    progress: Progress,
) -> DrivePlan:
    """Say what a drive will determine of its magnetometers, from poses and map alone.

    Parameters
    ----------
    bag
        A drive through the mapped place.
    config
        Configuration; `calibration.start` says where the bag's sensors are assumed.
    at
        Places of sensors in the lidar frame in metres that are assumed instead of the bag's own; a
        bag without magnetometers has one at the lidar if none is given.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    L2MError
        Whatever is wrong with the input, in one line.
    """
    # Of all that is done with drives only this needs them: a calibration starts sooner without.
    from l2m_gtsam.planning.plan import assumed_recording, plan

    saved, calibration = SavedMap.read(map_path), config.calibration
    if at or not has_fields(bag, config.bag):
        names = {_named(place): place for place in at or [(0.0, 0.0, 0.0)]}
        trajectory, source = read_trajectory(bag, config.bag), source_file(bag)
        recording = assumed_recording(trajectory, source, tuple(names), config.plan.rate_hz)
        calibration = calibration.model_copy(update={"start": names})
    else:
        recording = read_drive(bag, config, progress)
    field_map = saved.open(progress, [recording])
    return plan(recording, field_map, calibration, config.plan, progress)


def _named(place: tuple[float, float, float]) -> str:
    """Return the name of a sensor that is only assumed."""
    return f"at {place[0]:g},{place[1]:g},{place[2]:g}"

"""A calibration -> the figures that it is judged by, and its view. Pure: no files, no terminal."""

from l2m_gtsam.calibration.calibrate import Calibrated
from l2m_gtsam.calibration.options import CalibrationOptions
from l2m_gtsam.data import Recording
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress
from l2m_gtsam.qa.metrics.assemble import MapForms, Repeats, metrics_of
from l2m_gtsam.qa.metrics.evidence import DriveEvidence
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.repeatability import compared_drives, compared_halves
from l2m_gtsam.qa.scene import calibration_scene
from l2m_gtsam.records.metrics import Halves, Metrics, Repeatability
from l2m_gtsam.records.scene import Scene

FIGURES = "figures"
"""Stage of the figures of a calibration and its picture."""


@one_blas_thread()
def appraise(
    recording: Recording,
    calibrated: Calibrated,
    options: CalibrationOptions,
    qa: QaOptions,
    progress: Progress | None = None,
) -> Metrics:
    """Return the metrics of a calibration.

    Parameters
    ----------
    recording
        That was calibrated.
    calibrated
        The calibration, with what it rests on.
    options
        That it was computed with.
    qa
        Whether parts are calibrated by themselves, and on how many readings.
    progress
        Called with a stage and the fraction of it that is done.
    """
    tell = progress or (lambda stage, fraction: None)
    halves: dict[str, Halves] = {}
    drives: dict[str, Repeatability] = {}
    if qa.halves:
        stage = "drives by themselves" if recording.drives else "halves of the drive"
        tell(stage, 0.0)
        if recording.drives:
            drives = compared_drives(calibrated, recording, options, qa.half_readings)
        else:
            halves = compared_halves(calibrated, options, qa.half_readings)
        tell(stage, 1.0)
    tell(FIGURES, 0.0)
    evidence, maps = _evidence(calibrated), _maps(calibrated)
    metrics = metrics_of(calibrated.result, evidence, recording, maps, Repeats(halves, drives))
    tell(FIGURES, 0.5)
    return metrics


@one_blas_thread()
def scene_of(recording: Recording, calibrated: Calibrated) -> Scene:
    """Return what there is to see of a calibration in three dimensions.

    Parameters
    ----------
    recording
        That was calibrated.
    calibrated
        The calibration, with what it rests on.
    """
    evidence, maps = _evidence(calibrated), _maps(calibrated)
    name = recording.source.sha256
    drives = [each.trajectory for each in recording.parts]
    return calibration_scene(calibrated.result, evidence, drives, maps, name)


def _evidence(calibrated: Calibrated) -> DriveEvidence:
    solution = calibrated.solution
    return DriveEvidence(solution.readings, solution.inside, solution.rejected)


def _maps(calibrated: Calibrated) -> MapForms:
    return MapForms(calibrated.field_map, calibrated.solver_map)

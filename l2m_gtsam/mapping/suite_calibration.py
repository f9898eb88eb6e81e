"""Mapping drives -> the sensors of their suite, with no map and no calibration. Pure."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version

import numpy as np

from l2m_gtsam.data import Distortion, FloatArray, KnownSensor, Recording
from l2m_gtsam.errors import CalibrationError, L2MError
from l2m_gtsam.geometry import polar_rotation
from l2m_gtsam.mapping.options import SuiteCalibrationOptions
from l2m_gtsam.mapping.steady_survey import FEW, sound_survey, with_steady_sensors
from l2m_gtsam.mapping.suite_drive import SuiteDrive, suite_drive
from l2m_gtsam.mapping.suite_likelihood import SIZE, TAU
from l2m_gtsam.mapping.suite_poses import with_pose_errors
from l2m_gtsam.mapping.suite_solver import (
    SuiteSolution,
    SuiteStep,
    first_step,
    prior_information,
    prior_sigma,
    solve_suite,
)
from l2m_gtsam.parallel.threads import one_blas_thread
from l2m_gtsam.progress import Progress
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions
from l2m_gtsam.recording.saturation import saturation_doubts
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    SensorCalibration,
    SensorStatus,
    TimeOffset,
    Uncertainty,
)
from l2m_gtsam.solve.noise import residual_figures

NOTICED = 0.1  # share of the residuals' squares; sensors as assumed explain 16 S / 3 N of them
UNDETERMINED = 0.5  # share of the prior sigma above which the drive does not determine a parameter
FURTHEST = 6.0  # prior sigmas of a position; beyond, a rough field was taken for a sensor's
TOGETHER = 1.5  # variance of a direction in sigmas; errors that are independent have one
PARAMETERS = (
    *("t_lidar_mag x", "t_lidar_mag y", "t_lidar_mag z"),
    *(f"C[{i},{j}]" for i in range(3) for j in range(3)),
    *("H x", "H y", "H z"),
    "time offset",
)


@one_blas_thread()
def calibrate_suite(
    recordings: Sequence[Recording],
    assumed: Mapping[str, KnownSensor] | None,
    options: SuiteCalibrationOptions,
    progress: Progress,
    pose_noise: PoseNoiseOptions | None = None,
) -> CalibrationResult:
    """Calibrate the sensors of a mapping suite from its own drives.

    Parameters
    ----------
    recordings
        Drives of the suite with poses in one map frame.
    assumed
        Sensors by name, as far as they are known; the others are taken for ideal ones at the
        lidar's origin.
    options
        How sure that is, and how to solve.
    progress
        Called with a stage and the fraction of it that is done.
    pose_noise
        How wrong the drives' poses are, as for a map: where nothing says so it is looked for, with
        both sigmas 0 poses count as exact.

    Raises
    ------
    CalibrationError
        Drives do not go together, an axis of a sensor looks flipped, or the solve ended far from
        all that is assumed.
    MapError
        A sensor is stuck on one value, or there are too few readings.
    SyncError
        Readings and poses do not overlap.
    """
    sound = sound_survey(recordings, options)
    drive = suite_drive(sound.recordings, assumed, options)
    solution = solve_suite(drive.at, drive.assumed, options, progress)
    _check_ending(drive, solution, options)
    steady = with_steady_sensors(sound.recordings, drive, solution.last.sensors, options)
    if steady.doubts:
        drive = suite_drive(steady.recordings, assumed, options)
        solution = solve_suite(drive.at, drive.assumed, options, progress)
        _check_ending(drive, solution, options)
    posed = with_pose_errors(
        solution.last,
        drive.recording.trajectory,
        PoseNoiseOptions() if pose_noise is None else pose_noise,
        prior_information(len(drive.assumed), options),
    )
    found = _result(drive, replace(solution, last=posed.round), options)
    found = replace(found, doubts=(*found.doubts, *sound.doubts, *steady.doubts))
    if posed.found is None:
        return found
    return replace(found, doubts=(*found.doubts, posed.found.doubt))


@one_blas_thread()
def suite_doubts(
    recordings: Sequence[Recording],
    assumed: Mapping[str, KnownSensor] | None,
    options: SuiteCalibrationOptions,
) -> tuple[str, ...]:
    """Return a sentence where other sensors would explain a survey much better than the assumed.

    A map of sensors that are not what is assumed is wrong everywhere, and its noise hides it: the
    field that one place has under two headings is averaged. One step of the scoring that calibrates
    a suite tells how much of the residuals' squares the sensors would explain.

    Parameters
    ----------
    recordings, assumed
        As in ``calibrate_suite``.
    options
        Of the calibration; fewer windows, readings and modes are enough here.
    """
    few = options.model_copy(update=FEW)
    try:
        drive = suite_drive(recordings, assumed, few)
        step = first_step(drive.at, drive.assumed, few)
    except L2MError:  # a survey too small to judge its sensors by: the map has its own checks
        return ()
    if step.explained < NOTICED:
        return ()
    doubt = (
        "the survey's sensors look uncalibrated: a first step towards other values explains "
        f"{step.explained:.0%} of what the map takes for noise (largest change: "
        f"{_largest(step)}); calibrate them with `l2m map suite`, then build the map with --suite"
    )
    return (doubt,)


def _largest(step: SuiteStep) -> str:
    """Return the sensor's parameter that moves by the most of its sigmas."""
    sensor, k = np.unravel_index(np.argmax(np.abs(step.sigmas)), step.sigmas.shape)
    return f"{step.names[sensor]}, {PARAMETERS[k]}"


def _check_ending(
    drive: SuiteDrive, solution: SuiteSolution, options: SuiteCalibrationOptions
) -> None:
    """Refuse sensors that only a solve that got lost can have.

    Raises
    ------
    CalibrationError
        A sensor is metres off, or mirrored by a solve that never settled.
    """
    names, sensors = drive.readings.sensors, solution.last.sensors
    away = np.linalg.norm(sensors[:, :3] - drive.assumed[:, :3], axis=1)
    mirrored = ~(np.linalg.det(sensors[:, 3:12].reshape(-1, 3, 3)) > 0) & (not solution.converged)
    lost = mirrored | (away > FURTHEST * options.position_m)
    if lost.any():
        k = int(np.flatnonzero(lost)[0])
        raise CalibrationError(
            f"{names[k]}: the solve diverged: in {solution.rounds} rounds this sensor moved "
            f"{away[k]:.2g} m from its assumed position; give what is known of the sensors with "
            "--suite (turned ones with `bag.axes`), or keep further from steel"
        )


def _result(
    drive: SuiteDrive, solution: SuiteSolution, options: SuiteCalibrationOptions
) -> CalibrationResult:
    """Return a solution as a calibration."""
    common = errors_in_common(solution.last.covariance)
    sensors = tuple(
        replace(_sensor(drive, solution, i), common=common[SIZE * i : SIZE * (i + 1)])
        for i in range(len(drive.readings.sensors))
    )
    recording = drive.recording
    return CalibrationResult(
        sensors=sensors,
        iterations=solution.rounds,
        uncertainty=Uncertainty.FULL,
        doubts=(
            *_doubts(drive.readings.sensors, solution, options),
            *saturation_doubts(drive.readings.sensors, [each.limits for each in drive.counts]),
        ),
        disagreements=(),
        bag=None if recording.drives else recording.source,
        map=None,
        options=options.model_dump(mode="json"),
        versions={"l2m-gtsam": version("l2m-gtsam")},
        bags=tuple(each.source for each in recording.drives),
        notes=tuple(n for part in recording.parts for n in (*part.notes, *part.origins)),
    )


def errors_in_common(covariance: FloatArray) -> FloatArray:
    """Return a root of what the errors of several sensors have in common, shape (16 S, r).

    The principal directions in which errors of several parameters go together, a height of the
    whole suite first; what a covariance has beside them is each sensor's own.

    Parameters
    ----------
    covariance
        Of (t, C row by row, H, time offset) of S sensors, shape (16 S, 16 S).
    """
    sigma = np.sqrt(np.diag(covariance))
    squares, turned = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    several = squares > TOGETHER if len(covariance) > SIZE else np.zeros(len(squares), dtype=bool)
    return np.asarray(sigma[:, None] * turned[:, several] * np.sqrt(squares[several]))


def _sensor(drive: SuiteDrive, solution: SuiteSolution, i: int) -> SensorCalibration:
    own = slice(SIZE * i, SIZE * (i + 1))
    parameters, covariance = solution.last.sensors[i], solution.last.covariance[own, own]
    distortion = Distortion.from_vector(parameters[3:TAU])
    try:
        rotation = polar_rotation(distortion.C, covariance[3:12, 3:12])
    except CalibrationError as error:
        raise CalibrationError(f"{drive.readings.sensors[i]}: {error}") from None
    sigma = float(np.sqrt(covariance[TAU, TAU]))
    status, message = _ending(solution)
    noise = float(solution.last.windows.prior.noise * np.cbrt(np.linalg.det(distortion.C)))
    residual = solution.residuals[i]
    return SensorCalibration(
        sensor=drive.readings.sensors[i],
        status=status,
        message=message,
        t_lidar_mag=parameters[:3],
        distortion=distortion,
        R_lidar_mag=rotation.R_mag_lidar.T,
        covariance=covariance[:TAU, :TAU],
        rotation_covariance=rotation.covariance,
        noise=noise,
        residuals=residual_figures(residual, residual / noise, taken=0.0)
        if len(residual)
        else None,
        undetermined=(),
        sync=drive.counts[i],
        outside_map=0,
        time_offset=TimeOffset(float(parameters[TAU]), sigma, covariance[:TAU, TAU], ""),
    )


def _ending(solution: SuiteSolution) -> tuple[SensorStatus, str]:
    if solution.converged:
        return SensorStatus.SOLVED, "with the field of its own drive"
    message = (
        f"still moving after {solution.rounds} rounds; allow more with mapping.suite.rounds, or "
        "give what is known with --suite"
    )
    return SensorStatus.NOT_CONVERGED, message


def _doubts(
    names: Sequence[str], solution: SuiteSolution, options: SuiteCalibrationOptions
) -> tuple[str, ...]:
    """Return the parameters that the drive hardly determines, a sentence for each sensor."""
    sigma = np.sqrt(np.diag(solution.last.covariance)).reshape(len(names), SIZE)
    assumed = prior_sigma(options)
    sentences = []
    for name, own in zip(names, sigma, strict=True):
        if weak := [PARAMETERS[k] for k in np.flatnonzero(own > UNDETERMINED * assumed)]:
            sentences.append(
                f"{name}: the drive hardly determines {', '.join(weak)}; drive with all headings "
                "and some tilt, or give what is known with --suite"
            )
    return tuple(sentences)

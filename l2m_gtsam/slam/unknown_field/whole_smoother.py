"""Batch SLAM of one sensor in an unknown field: poses and one field for the whole drive.

The drive is solved by :mod:`.smoothed_drive`. Sigmas are those of the density with the field
integrated out (:mod:`.path_information`), and poses are corrected where a gain is shown.
"""

from dataclasses import replace
from functools import cached_property, partial

import gtsam
import numpy as np
from scipy.spatial.distance import cdist

from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.progress import Progress, completed
from l2m_gtsam.slam.drive import Drive, KnownSensors, stacked
from l2m_gtsam.slam.map_prediction import PlacedReadings, poses_in
from l2m_gtsam.slam.marginals import pose_covariances
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import drive_graph, drive_values
from l2m_gtsam.slam.solution import REJECTED_WEIGHT, DriveSolution
from l2m_gtsam.slam.solver import marginals_of
from l2m_gtsam.slam.unknown_field.gain import gain_of
from l2m_gtsam.slam.unknown_field.path_information import (
    PathInformation,
    PathNeighbourhood,
    path_information,
)
from l2m_gtsam.slam.unknown_field.sensor_noise import NoiseInformation
from l2m_gtsam.slam.unknown_field.smoothed_drive import (
    FOLLOWED,
    OFF_LINE,
    SmoothedDrive,
    followed,
    smoothed,
    solved_stage,
    stage_problem,
    with_noise,
)
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.tiled_smoother import AWAY_M, FieldSolution
from l2m_gtsam.slam.unknown_field.whole_field import (
    WholePrior,
    fine_prior,
    learnt_prior,
    log_likelihood_at,
    prior_about,
)

HELD = 1e-3  # of odometry's sigmas: steps that are known so well leave the poses where they are
TOGETHER = 256  # key poses whose distances are computed at once
SETTLED = 1.0  # movement of the poses in the last round, in their sigmas


def map_whole_drive(
    drive: Drive, initial: list[gtsam.Pose3], options: SlamOptions, progress: Progress
) -> FieldSolution | None:
    """Estimate the poses of a drive and one field along it.

    Parameters
    ----------
    drive
        The drive.
    initial
        K key poses by odometry.
    options
        How to solve.
    progress
        Called with a stage and the fraction of it that is done.

    Returns
    -------
    The poses; those of odometry where nothing is shown to be gained by others. None where the field
    has more detail than one basis holds.
    """
    stage = "solving poses and field"
    found = completed(smoothed(drive, initial, options), partial(progress, stage))
    if found is None:
        return None
    solution = where_gained(drive, found, options)
    progress(stage, 1.0)
    return solution


def where_gained(drive: Drive, smooth: SmoothedDrive, options: SlamOptions) -> FieldSolution:
    """Return a solved drive; where nothing is shown to be gained, at the poses of odometry.

    Parameters
    ----------
    drive, smooth
        The drive, and its solution.
    options
        How to solve.
    """
    last, whole = smooth.stage.last, options.whole_field
    solved = smooth.problem.finished(last)
    weights = np.maximum(solved.solution.weights, REJECTED_WEIGHT)
    own = solved.solution.drive
    noise = NoiseInformation(smooth.noise, own.progress_at_readings, weights)
    information = path_information(
        PathNeighbourhood(own, last.poses, last.values, smooth.prior.field, noise)
    )
    found = with_information(solved, information)
    odometry = drive.dead_reckoning()
    learnt = fine_prior(drive, last.poses, whole, smooth.prior.spectrum)
    before = fine_prior(drive, odometry, whole, smooth.first.spectrum)
    likelier = log_likelihood_at(drive, last.poses, whole, learnt.spectrum)
    likelier -= log_likelihood_at(drive, odometry, whole, before.spectrum)
    likelier -= found.solution.bent + information.narrowed
    gain = gain_of(found.solution.poses, odometry, information, likelier)
    if gain.shown:
        settled = is_settled(smooth.stage.before, found.solution)
        ending = Ending.TOLERANCE if settled else Ending.ITERATION_LIMIT
        found = replace(found, solution=replace(found.solution, ending=ending), noise=smooth.noise)
    else:
        learnt, found = before, at_odometry(drive, before, options)
    solution = found.solution
    if options.calibration is not CalibrationUse.REFINED:
        solution = as_calibrated(solution, drive.sensors)
    _, p = stacked(solution.poses)
    near = learnt.spectrum.prior.length
    return replace(found, solution=solution, gain=gain, returns=returned(p, drive.steps.path, near))


def with_information(found: FieldSolution, information: PathInformation) -> FieldSolution:
    """Return a solved drive with the covariances of its density without weights."""
    solution, taken = found.solution, information.sensors
    jumps = [information.step_covariance(each.step) for each in solution.drive.jumps]
    solution = replace(
        solution,
        pose_covariance=information.pose_covariances(),
        calibration_covariance=solution.drive.sensors.covariance - taken @ taken.transpose(0, 2, 1),
        step_covariance=np.reshape(jumps, solution.step_covariance.shape),
    )
    return replace(found, solution=solution, marginals=information)


def as_calibrated(solution: DriveSolution, sensors: KnownSensors) -> DriveSolution:
    """Return a solution whose field is that by given calibrations, as its readers will have it."""
    readings = solution.prediction.placed.readings
    known = replace(sensors, noise=solution.drive.sensors.noise)
    return replace(
        solution,
        drive=replace(solution.drive, sensors=known),
        calibration_covariance=sensors.covariance,
        prediction=replace(solution.prediction, placed=PlacedReadings.of(readings, known)),
    )


def is_settled(before: FloatArray, solution: DriveSolution) -> bool:
    """Return whether poses have moved from ``before``, (K, 3), by no more than their sigmas."""
    _, after = stacked(solution.poses)
    variance = np.trace(solution.pose_covariance[:, 3:, 3:], axis1=1, axis2=2)
    moved = np.sum((after - before) ** 2, axis=1)
    return bool(moved.mean() <= SETTLED**2 * variance.mean())


class DriveLikelihood:
    """How likely a drive's readings are given its odometry: poses and field are integrated out.

    Field and noise are those that are learnt with all steps as they were recorded.

    Parameters
    ----------
    drive
        A drive whose odometry jumps.
    options
        How the field is described.
    """

    def __init__(self, drive: Drive, options: SlamOptions) -> None:
        self._drive, self._options = drive, options

    def __call__(self, drive: Drive) -> float:
        """Return the logarithm, but for constants; minus infinity where one basis does not do."""
        if self._spectrum is None:
            return -np.inf
        whole = self._options.whole_field
        prior = prior_about(drive, drive.dead_reckoning(), whole, self._spectrum)
        if prior is None:
            return -np.inf
        return followed(drive, prior, FOLLOWED[0], self._options).log_likelihood

    @cached_property
    def _spectrum(self) -> FieldSpectrum | None:
        recorded = self._drive.as_recorded(self._drive.jumps)
        learnt = learnt_prior(recorded, recorded.dead_reckoning(), self._options.whole_field)
        return None if learnt is None else learnt.spectrum


def at_odometry(drive: Drive, prior: WholePrior, options: SlamOptions) -> FieldSolution:
    """Return the field along the poses of odometry, which stay what they are.

    Parameters
    ----------
    drive
        The drive.
    prior
        What was learnt of field and noise at odometry's poses.
    options
        How to solve.

    Returns
    -------
    The field, and odometry's poses with their own covariances.
    """
    whole, noise = options.whole_field, prior.spectrum.noise.floored()
    steps = replace(
        drive.steps,
        covariance=HELD**2 * drive.steps.covariance,
        scale=0.0,
        steady=None,
        turning=None,
    )
    sensors = with_noise(drive.sensors.loosened(whole.distortion, whole.offset), noise)
    held = replace(drive, steps=steps, sensors=sensors)
    last = OFF_LINE[-1]
    problem = stage_problem(held, prior, noise, options, last.iterations)
    stage = solved_stage(problem, drive.dead_reckoning(), sensors, last.rounds)
    found = problem.finished(stage.last)
    graph, values = drive_graph(drive), drive_values(drive, drive.dead_reckoning())
    marginals = marginals_of(graph, values)
    solution = replace(
        found.solution,
        drive=replace(drive, sensors=found.solution.drive.sensors),
        poses=poses_in(values, len(drive)),
        pose_covariance=pose_covariances(marginals, len(drive)),
        odometry_chi2=0.0,
        ending=Ending.TOLERANCE,
    )
    return replace(found, solution=solution, marginals=marginals, noise=noise)


def returned(p: FloatArray, path: FloatArray, near_m: float) -> IntArray:
    """Return the key poses that lie near one from which the vehicle had gone away.

    Parameters
    ----------
    p, path
        Of K key poses: positions and path length from the start in metres, shapes (K, 3) and (K,).
    near_m
        Distance within which the field is the same.
    """
    before = np.searchsorted(path, path - (AWAY_M + near_m), side="right")
    found = [
        k + row
        for k in range(0, len(p), TOGETHER)
        for row, near in enumerate(cdist(p[k : k + TOGETHER], p) <= near_m)
        if near[: before[k + row]].any()
    ]
    return np.array(found, dtype=np.int64)

"""Batch SLAM of one sensor in an unknown field: poses and one field for the whole drive.

A Kalman filter follows the drive (:mod:`.forward_pass`), and from there Levenberg-Marquardt solves
poses, field, the distortion and the slow error of the sensor together. What field and noise are
like is learnt before each (:mod:`.spectrum`): at the poses of odometry it takes what these are
wrong by for noise that lasts, so that the filter is no surer of them than the readings allow.

The distortion is a variable even where the calibration is fixed: what steel on the vehicle adds is
the same at all headings, and without a map nothing else than tilts and headings of the poses could
take it up. The filter has the offset alone free: it meets field and distortion as a product of two
unknowns, which it could linearise at nothing better than zero.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from l2m_factors import X
from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.drive import Drive, KnownSensors, as_pose
from l2m_gtsam.slam.map_prediction import PlacedReadings, poses_in
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions
from l2m_gtsam.slam.pose_graph import odometry_graph, shared_values
from l2m_gtsam.slam.solution import REJECTED_WEIGHT, DriveSolution
from l2m_gtsam.slam.solver import Marginals, colamd_ordering, pose_covariances, weights_last
from l2m_gtsam.slam.unknown_field.forward_pass import FollowedDrive, followed
from l2m_gtsam.slam.unknown_field.gain import gain_of
from l2m_gtsam.slam.unknown_field.path_information import path_information
from l2m_gtsam.slam.unknown_field.sensor_noise import SensorNoise, SlowErrors
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.tiled_smoother import (
    AWAY_M,
    FieldSolution,
    TiledProblem,
    TiledRound,
)
from l2m_gtsam.slam.unknown_field.whole_field import (
    WholePrior,
    learnt_prior,
    prior_about,
)

CONVEX = 1.0  # of the loss, with weights at the poses of the filter
# Factors of the noise. With the noise alone the likelihood has maxima between the poses of odometry
# and the best ones, and a filter that linearises once is led to one of them: on the model ship it
# finds back with 3 to 8 times the noise, and ends up to 5 m off with the noise alone.
FOLLOWED = (2.0, 4.0)  # of the filter's passes, the first at odometry's poses
STAGES = (4.0, 2.0, 1.0)  # of the smoother's stages
ROUNDS = (2, 2, 3)  # of each: readings are hung and weighed anew at the poses
ITERATIONS = 4  # of each round
CLOSE = 0.5  # decrease of the error that moves poses by less than their sigmas
HELD = 1e-3  # of odometry's sigmas: steps that are known so well leave the poses where they are
SETTLED = 1.0  # movement of the poses in the last round, in their sigmas


@dataclass(frozen=True)
class LearntPoses:
    """Poses, and what was learnt at them.

    Attributes
    ----------
    poses
        K key poses.
    prior
        Of the field, with the noise.
    """

    poses: list[gtsam.Pose3]
    prior: WholePrior


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
    whole = options.whole_field
    progress("following the drive", 0.0)
    first = learnt_prior(drive, initial, whole)
    learnt = None if first is None else followed_coarsely(drive, first, options)
    if first is None or learnt is None:
        return None
    free = replace(drive, sensors=drive.sensors.loosened(whole.distortion, whole.offset))
    sensors = free.sensors
    for stage, factor in enumerate(STAGES):
        progress("solving poses and field", stage / len(STAGES))
        noise = learnt.prior.spectrum.noise.floored().scaled(factor)
        field = learnt.prior
        problem = stage_problem(free, field, noise, options)
        solved = settled(problem, learnt.poses, with_noise(sensors, noise), ROUNDS[stage])
        sensors = solved.last.sensors
        prior = learnt_prior(drive, solved.last.poses, whole, field.spectrum)
        if prior is None:
            return None
        learnt = LearntPoses(solved.last.poses, prior)
    found = with_information(problem.finished(solved.last), solved.last.values, field, noise)
    bent = 0.5 * found.solution.odometry_chi2 * 6 * len(drive)
    likelier = learnt.prior.spectrum.log_likelihood - first.spectrum.log_likelihood - bent
    gain = gain_of(found.solution.poses, drive.dead_reckoning(), found.marginals, likelier)
    if gain.shown:
        ending = Ending.TOLERANCE if is_settled(solved, found.solution) else Ending.ITERATION_LIMIT
        found = replace(found, solution=replace(found.solution, ending=ending), noise=noise)
    else:
        learnt, found = LearntPoses(initial, first), at_odometry(drive, first, options)
    solution = found.solution
    if options.calibration is CalibrationUse.FIXED:
        solution = as_calibrated(solution, drive.sensors)
    progress("solving poses and field", 1.0)
    p = np.stack([pose.translation() for pose in solution.poses])
    near = learnt.prior.spectrum.prior.length
    return replace(found, solution=solution, gain=gain, returns=returned(p, drive.steps.path, near))


def with_information(
    found: FieldSolution, values: gtsam.Values, prior: WholePrior, noise: SensorNoise
) -> FieldSolution:
    """Return a solved drive with the covariances of its density without weights.

    Parameters
    ----------
    found, values
        The solution of the graph of poses and weights.
    prior, noise
        Of the field and of the readings in that graph.
    """
    solution = found.solution
    drive, weights = solution.drive, np.maximum(solution.weights, REJECTED_WEIGHT)
    information = path_information(drive, solution.poses, values, prior, noise, weights)
    jumps = [information.step_covariance(each.step) for each in drive.jumps]
    solution = replace(
        solution,
        pose_covariance=information.pose_covariances(),
        calibration_covariance=drive.sensors.covariance - information.sensor @ information.sensor.T,
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


def with_noise(sensors: KnownSensors, noise: SensorNoise) -> KnownSensors:
    """Return sensors, one, with such noise."""
    return replace(sensors, noise=np.array([noise.ut]))


def stage_problem(
    drive: Drive, prior: WholePrior, noise: SensorNoise, options: SlamOptions
) -> TiledProblem:
    """Return the graph of a whole drive in one field, with such noise of its sensor."""
    refined = options.model_copy(
        update={"calibration": CalibrationUse.REFINED, "max_iterations": ITERATIONS}
    )
    slow = SlowErrors(noise, drive.stamp_ns, drive.reading_ns)
    heard = replace(drive, sensors=with_noise(drive.sensors, noise))
    return TiledProblem(heard, prior.divided, refined, weights_last, slow, CLOSE)


@dataclass(frozen=True)
class SettledStage:
    """The last round of a stage, and the positions of its poses before it, (K, 3), metres."""

    last: TiledRound
    before: FloatArray


def settled(
    problem: TiledProblem, poses: list[gtsam.Pose3], sensors: KnownSensors, rounds: int
) -> SettledStage:
    """Solve a stage in so many rounds."""
    for _ in range(rounds):
        before = np.stack([pose.translation() for pose in poses])
        solved = problem.solved(poses, sensors, 1.0, CONVEX)
        poses, sensors = solved.poses, solved.sensors
    return SettledStage(solved, before)


def is_settled(stage: SettledStage, solution: DriveSolution) -> bool:
    """Return whether the last round moved the poses by no more than their sigmas."""
    after = np.stack([pose.translation() for pose in solution.poses])
    variance = np.trace(solution.pose_covariance[:, 3:, 3:], axis1=1, axis2=2)
    moved = np.sum((after - stage.before) ** 2, axis=1)
    return bool(moved.mean() <= SETTLED**2 * variance.mean())


def followed_coarsely(drive: Drive, first: WholePrior, options: SlamOptions) -> LearntPoses | None:
    """Follow a drive twice, with what was learnt at odometry's poses and again at those found.

    Parameters
    ----------
    drive
        The drive.
    first
        What was learnt of field and noise at odometry's poses.
    options
        How the field is described.

    Returns
    -------
    None where the field has more detail than one basis holds.
    """
    prior = first
    for factor in FOLLOWED:
        poses = followed_with(drive, prior, factor, options).poses
        learnt = learnt_prior(drive, poses, options.whole_field, prior.spectrum)
        if learnt is None:
            return None
        prior = learnt
    return LearntPoses(poses, prior)


def followed_with(
    drive: Drive, prior: WholePrior, factor: float, options: SlamOptions
) -> FollowedDrive:
    """Follow a drive in one field, with so many times the noise, all of it white."""
    sensors = drive.sensors.loosened(0.0, options.whole_field.offset)
    noise = np.array([factor * prior.spectrum.noise.ut])
    heard = replace(drive, sensors=replace(sensors, noise=noise))
    scaled = heard.with_scale_as_drift(options.drift.over_m)
    return followed(scaled, prior.field, as_pose(drive.start.T_map_lidar), options.robust.largest)


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
        return followed_with(drive, prior, FOLLOWED[0], self._options).log_likelihood

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
        drive.steps, covariance=HELD**2 * drive.steps.covariance, scale=0.0, steady=None
    )
    sensors = with_noise(drive.sensors.loosened(whole.distortion, whole.offset), noise)
    problem = stage_problem(replace(drive, steps=steps, sensors=sensors), prior, noise, options)
    found = problem.finished(settled(problem, drive.dead_reckoning(), sensors, ROUNDS[-1]).last)
    values = shared_values(drive)
    for k, pose in enumerate(drive.dead_reckoning()):
        values.insert(X(k), pose)
    graph = odometry_graph(drive)
    marginals = Marginals(graph.linearize(values), colamd_ordering(graph))
    solution = replace(
        found.solution,
        drive=replace(drive, sensors=found.solution.drive.sensors),
        poses=list(poses_in(values, len(drive)).values()),
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
    apart = np.linalg.norm(p[:, None] - p, axis=2)
    earlier = path[:, None] - path >= AWAY_M + near_m
    return np.flatnonzero((earlier & (apart <= near_m)).any(axis=1))

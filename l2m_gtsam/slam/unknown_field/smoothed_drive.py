"""A drive with one sensor and one field, solved stage by stage, and what is known at its end.

A Kalman filter follows the drive, and from there Levenberg-Marquardt solves poses, field, the
distortion and the slow error of the sensor together. What field and noise are like is learnt before
each (:mod:`.spectrum`): at the poses of odometry it takes what these are wrong by for noise that
lasts, so that the filter is no surer of them than the readings allow.

The distortion is a variable even where the calibration is fixed: what steel on the vehicle adds is
the same at all headings, and without a map nothing else than tilts and headings of the poses could
take it up. The filter has the offset alone free: it meets field and distortion as a product of two
unknowns, which it could linearise at nothing better than zero.

A filter goes on where the drive ends. Errors of path and sensor then have the covariance of the
density without weights (:mod:`.path_information`). The weights follow these to first order, and
have their own covariance on a given path beside it. The graph's own covariance would take the path
for better known than the field allows.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_factors import D, M, V
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import Drive, KnownSensors, as_pose, stacked
from l2m_gtsam.slam.odometry import FixedStep
from l2m_gtsam.slam.online.belief import POSE, SENSOR
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, WholeFieldOptions
from l2m_gtsam.slam.relative_motion import from_end
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.solver import weights_last
from l2m_gtsam.slam.unknown_field.field_filter import NO_DRIFT, FieldFilter, FilterState, FilterStep
from l2m_gtsam.slam.unknown_field.path_information import PathNeighbourhood, determined
from l2m_gtsam.slam.unknown_field.sensor_noise import (
    NoiseInformation,
    SensorNoise,
    SlowErrors,
)
from l2m_gtsam.slam.unknown_field.spectrum import FieldSpectrum
from l2m_gtsam.slam.unknown_field.tiled_smoother import TiledProblem, TiledRound
from l2m_gtsam.slam.unknown_field.whole_field import WholePrior, fine_prior, learnt_prior

CONVEX = 1.0  # of the loss, with weights at the poses of the filter
# Factors of the noise. With the noise alone the likelihood has maxima between the poses of odometry
# and the best ones, and a filter that linearises once is led to one of them: on the model ship it
# finds back with 3 to 8 times the noise, and ends up to 5 m off with the noise alone.
FOLLOWED = (4.0, 8.0)  # of the filter's passes, the first at odometry's poses
CLOSE = 0.5  # decrease of the error that moves poses by less than their sigmas
# Sigmas of the ship's poses are 5 to 16 % larger than with 120, heights 26 %, in less than half the
# time.
VECTORS = 50


@dataclass(frozen=True)
class FollowedDrive:
    """A drive that was followed.

    Attributes
    ----------
    poses
        K key poses, each by the readings until then.
    log_likelihood
        Of all readings, as of a ``FilterState``.
    """

    poses: list[gtsam.Pose3]
    log_likelihood: float


def followed(drive: Drive, prior: WholePrior, factor: float, options: SlamOptions) -> FollowedDrive:
    """Follow a drive in one field, with so many times the noise, all of it white."""
    sensors = drive.sensors.loosened(0.0, options.whole_field.offset)
    noise = np.array([factor * prior.spectrum.noise.ut])
    follows = FieldFilter(prior.field, replace(sensors, noise=noise), options.robust.largest)
    state = follows.start()
    poses = [state.pose]
    for step in filter_steps(drive.with_scale_as_drift(options.drift.over_m)):
        state = follows.after(state, step)
        poses.append(state.pose)
    origin = as_pose(drive.start.T_map_lidar)
    return FollowedDrive([origin.compose(each) for each in poses], state.log_likelihood)


def filter_steps(drive: Drive) -> Iterator[FilterStep]:
    """Yield the steps of a drive with their readings.

    A steady drift counts as large along all axes as along the largest: none of the filter's axes,
    those of the first key pose, need be vertical.
    """
    steps, key = drive.steps, drive.readings.key_pose
    if steps.steady is not None:
        largest = np.repeat(steps.steady.max(axis=2, keepdims=True), 3, axis=2)
        steps = replace(steps, steady=largest)
    drifts = steps.drifts(steps.up_start)
    readings = from_end(drive.readings, steps.R[key], steps.p[key])
    bounds = np.searchsorted(key, np.arange(len(steps) + 1))
    for k in range(len(steps)):
        fixed = steps.fixed_axes
        yield FilterStep(
            drive.step(k),
            steps.covariance[k],
            readings[np.arange(bounds[k], bounds[k + 1])],
            NO_DRIFT if drifts is None else drifts[k],
            None if fixed is None else FixedStep(steps.fixed_turns[k], fixed[k]),
        )


@dataclass(frozen=True)
class Stage:
    """One stage of the smoother.

    Attributes
    ----------
    noise_factor
        The noise of readings that counts, over that which is learnt.
    rounds
        Readings are hung and weighed anew at the poses in each.
    iterations
        The most of each round.
    learn
        Learns the field before it, at the poses found so far. Before the first the filter has.
    """

    noise_factor: float
    rounds: int
    iterations: int
    learn: Callable[
        [Drive, list[gtsam.Pose3], WholeFieldOptions, FieldSpectrum], WholePrior | None
    ] = learnt_prior


# The field is fine in the end, where poses are within its short waves, and that stage has to
# converge: after four iterations poses of a sensor in the hand are up to four times as far off.
# Noise that is learnt at poses which readings have moved is too small: with the poses integrated
# out (Laplace) readings are likeliest with 1.5 times of it.
OFF_LINE = (Stage(6.0, 2, 4), Stage(3.0, 2, 4), Stage(1.5, 2, 30, fine_prior))
# On line a fine field gains nothing, as the filter goes on with coarse poses. Nor do readings with
# their noise alone: the last poses of a drive so far, which nothing after them holds, follow it.
ON_LINE = (Stage(4.0, 1, 4), Stage(1.5, 1, 4))


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


@dataclass(frozen=True)
class SolvedStage:
    """The last round of a stage, and the positions of its poses before it, (K, 3), metres."""

    last: TiledRound
    before: FloatArray


@dataclass(frozen=True)
class SmoothedDrive:
    """A drive solved with one field, and what that was solved with.

    Attributes
    ----------
    drive
        With what may be left of C and H.
    problem, stage
        The graph of the last stage, and its solution.
    prior, noise
        Of the field and of the readings in it.
    first
        What was learnt at the poses of odometry.
    """

    drive: Drive
    problem: TiledProblem
    stage: SolvedStage
    prior: WholePrior
    noise: SensorNoise
    first: WholePrior


def smoothed(
    drive: Drive,
    initial: list[gtsam.Pose3],
    options: SlamOptions,
    stages: Sequence[Stage] = OFF_LINE,
) -> Generator[float, None, SmoothedDrive | None]:
    """Solve a drive with one field, in pieces; yield the share that is done before each.

    Parameters
    ----------
    drive
        The drive.
    initial
        K key poses by odometry.
    options
        How to solve.
    stages
        Of the smoother, after the filter.

    Returns
    -------
    None where the field has more detail than one basis holds.
    """
    whole, count = options.whole_field, 2 + sum(each.rounds for each in stages)
    yield 0.0
    first = learnt_prior(drive, initial, whole)
    yield 1 / count
    learnt = None if first is None else followed_coarsely(drive, first, options)
    if first is None or learnt is None:
        return None
    free = replace(drive, sensors=drive.sensors.loosened(whole.distortion, whole.offset))
    poses, sensors, prior, done = learnt.poses, free.sensors, learnt.prior, 2
    for number, each in enumerate(stages):
        if number > 0:
            yield done / count
            following = each.learn(drive, poses, whole, prior.spectrum)
            if following is None:
                return None
            prior = following
        noise = prior.spectrum.noise.floored().scaled(each.noise_factor)
        problem = stage_problem(free, prior, noise, options, each.iterations)
        sensors = with_noise(sensors, noise)
        for _ in range(each.rounds):
            yield done / count
            solved, done = solved_stage(problem, poses, sensors), done + 1
            poses, sensors = solved.last.poses, solved.last.sensors
    return SmoothedDrive(free, problem, solved, prior, noise, first)


def with_noise(sensors: KnownSensors, noise: SensorNoise) -> KnownSensors:
    """Return sensors, one, with such noise."""
    return replace(sensors, noise=np.array([noise.ut]))


def stage_problem(
    drive: Drive, prior: WholePrior, noise: SensorNoise, options: SlamOptions, iterations: int
) -> TiledProblem:
    """Return the graph of a whole drive in one field, with such noise of its sensor.

    Each round of it takes so many iterations at most.
    """
    refined = options.model_copy(
        update={"calibration": CalibrationUse.REFINED, "max_iterations": iterations}
    )
    slow = SlowErrors(noise, drive.progress, drive.progress_at_readings)
    heard = replace(drive, sensors=with_noise(drive.sensors, noise))
    return TiledProblem(heard, prior.divided, refined, weights_last, slow, CLOSE)


def solved_stage(
    problem: TiledProblem, poses: list[gtsam.Pose3], sensors: KnownSensors, rounds: int = 1
) -> SolvedStage:
    """Solve a stage in so many rounds from initial poses and sensors."""
    for _ in range(rounds):
        _, before = stacked(poses)
        solved = problem.solved(poses, sensors, 1.0, CONVEX)
        poses, sensors = solved.poses, solved.sensors
    return SolvedStage(solved, before)


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
        poses = followed(drive, prior, factor, options).poses
        learnt = learnt_prior(drive, poses, options.whole_field, prior.spectrum)
        if learnt is None:
            return None
        prior = learnt
    return LearntPoses(poses, prior)


def end_state(smooth: SmoothedDrive) -> FilterState:
    """Return what is known at the last key pose of a drive with one sensor.

    The pose is relative to the first, as the field is.
    """
    last = smooth.stage.last
    poses, values = last.poses, last.values
    drive = replace(smooth.drive, sensors=with_noise(last.sensors, smooth.noise))
    robust = np.maximum(last.weights, REJECTED_WEIGHT)
    noise = NoiseInformation(smooth.noise, drive.progress_at_readings, robust)
    near = PathNeighbourhood(drive, poses, values, smooth.prior.field, noise)
    weights, K = values.atVector(M(0)), len(poses)
    of_path, pose = near.density.weights(weights, near.sensors[0]), poses[0].between(poses[-1])
    m, distortion = len(weights), SENSOR - 3
    steady = values.atVector(V()) if values.exists(V()) else np.zeros(DRIFT)
    # Rows: relative pose, weights, distortion, drift.
    size = POSE + m + distortion + DRIFT
    by_poses, by_drift = np.zeros((size, K, POSE)), np.zeros((size, DRIFT))
    by_sensor = np.zeros((size, SENSOR))
    own, of_weights = np.arange(POSE), slice(POSE, POSE + m)
    by_poses[own, -1, own] = 1.0
    by_poses[:POSE, 0] = -pose.inverse().AdjointMap()
    by_poses[of_weights] = near.by_key_poses(of_path.by_path)
    by_sensor[of_weights] = of_path.by_sensor
    by_sensor[POSE + m : POSE + m + distortion, 3:] = np.eye(distortion)
    by_drift[size - DRIFT :] = np.eye(DRIFT)
    root = near.by_errors(by_poses, by_drift, by_sensor)
    taken = root @ determined(near, VECTORS)
    covariance = root @ root.T - taken @ taken.T
    covariance[of_weights, of_weights] += of_path.covariance
    if not values.exists(V()):
        covariance[size - DRIFT :, size - DRIFT :] = np.eye(DRIFT)
    return FilterState(pose, weights, values.atVector(D(0)).reshape(1, -1), steady, covariance, 0.0)

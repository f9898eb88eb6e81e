"""Batch SLAM of several sensors in one field, for drives that are small enough.

Tiles hold the field of a large area, each by itself, and their waves follow errors of the poses. In
a room all readings determine the same waves, and these can be integrated out: poses go to the mode
of their own density (:mod:`.path_mode`), with sigmas of that (:mod:`.path_information`). The solve
begins at the poses of the tiles.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from l2m_gtsam.calibration.optimise import Ending
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.localisation import Gain
from l2m_gtsam.slam.drive import Drive, KnownSensors, stacked
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.options import CalibrationUse, SlamOptions, WholeFieldOptions
from l2m_gtsam.slam.pose_graph import drive_values
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.solver import weights_last
from l2m_gtsam.slam.unknown_field.gain import gain_of
from l2m_gtsam.slam.unknown_field.path_information import (
    PathInformation,
    PathNeighbourhood,
    path_information,
)
from l2m_gtsam.slam.unknown_field.path_mode import likeliest_errors
from l2m_gtsam.slam.unknown_field.sensor_noise import WhiteInformation
from l2m_gtsam.slam.unknown_field.tiled_smoother import (
    FieldSolution,
    TiledProblem,
    TiledRound,
)
from l2m_gtsam.slam.unknown_field.wave_prior import (
    WavePrior,
    box_about,
    heard_waves,
    learnt_waves,
)
from l2m_gtsam.slam.unknown_field.whole_smoother import (
    as_calibrated,
    is_settled,
    returned,
    with_information,
)

CONVEX = 1.0  # of the loss by which readings are weighed
MOST_WAVES, FEWEST_WAVES = 900, 50
LEARNT = 0.5  # of a reading's noise: what waves that are left out come to when a field is learnt
# Doubt of a correction by tiles, below which these close all loops, with safer sigmas. Of the robot
# steady drifts leave 4e-4 at most, walks 5e-3 and more.
SURE = 1e-3


@dataclass(frozen=True)
class JointStage:
    """Field and noise are learnt, readings weighed, and the likeliest path is sought.

    Attributes
    ----------
    noise_factor
        The noise of readings that counts, over that which is learnt.
    iterations
        The most of the search.
    """

    noise_factor: float
    iterations: int


# With the noise alone poses of tiles that are off by half a wave stay there. Then the search goes
# on: after two stages of the last kind a pass of the robot was 85 mm off with NEES 22, after four
# 68 mm with 12 (249 mm by odometry).
FIRST, LAST = JointStage(4.0, 60), JointStage(1.0, 150)
STAGES = (FIRST, LAST, LAST, LAST, LAST)


@dataclass(frozen=True)
class JointEstimate:
    """Poses with odometry's steady drift or scale, and sensors."""

    values: gtsam.Values
    poses: list[gtsam.Pose3]
    sensors: KnownSensors


def is_sure(gain: Gain | None) -> bool:
    """Return whether what a correction by tiles gains leaves no doubt."""
    return gain is not None and gain.shown and gain.doubt < SURE


def solve_jointly(
    drive: Drive,
    tiled: FieldSolution,
    odometry: list[gtsam.Pose3],
    options: SlamOptions,
    progress: Progress,
) -> FieldSolution | None:
    """Estimate the poses of a drive with several sensors, and one field along it.

    Parameters
    ----------
    drive
        K key poses with means of readings, without links.
    tiled
        Its solution in tiles.
    odometry
        Its key poses by odometry alone.
    options
        How to solve.
    progress
        Called with a stage and the fraction of it that is done.

    Returns
    -------
    The corrected poses; None where the drive is too large for one field, or nothing is shown to be
    gained.
    """
    begun = drive_values(drive, tiled.solution.poses)
    found = JointEstimate(begun, tiled.solution.poses, drive.sensors)
    before = found
    learnt, most = None, most_waves(drive, options.whole_field)
    if most < FEWEST_WAVES:
        return None
    for number, stage in enumerate(STAGES):
        progress("solving poses in one field", number / len(STAGES))
        learnt = prior_about(drive, found.poses, most, stage.noise_factor, learnt)
        if learnt is None:
            return None
        # Of a sensor that has changed all readings would be rejected with what is calibrated.
        before = replace(found, sensors=drive.sensors.at(learnt.sensors))
        problem = OneFieldProblem.of(drive, learnt, stage.noise_factor, options)
        found = problem.likeliest(before, stage.iterations)
    solved = None if learnt is None else with_gain(drive, found, learnt, odometry, options)
    progress("solving poses in one field", 1.0)
    if solved is None or solved.gain is None or not solved.gain.shown:
        return None
    _, p = stacked(before.poses)
    ending = Ending.TOLERANCE if is_settled(p, solved.solution) else Ending.ITERATION_LIMIT
    solution = replace(solved.solution, ending=ending)
    if options.calibration is not CalibrationUse.REFINED:
        solution = as_calibrated(solution, drive.sensors)
    return replace(solved, solution=solution)


def prior_about(
    drive: Drive,
    poses: list[gtsam.Pose3],
    most: int,
    unheard: float,
    first: WavePrior | None,
) -> WavePrior | None:
    """Learn field and noise at poses, and return them with the waves that readings hear.

    Parameters
    ----------
    drive
        The drive.
    poses
        Estimates.
    most
        Limit of waves.
    unheard
        Strength of waves that are not heard, in that of the noise.
    first
        What was learnt at others.

    Returns
    -------
    What is learnt; None where the field needs more waves than it may have.
    """
    learnt, frame = learnt_about(drive, poses, most, first), box_about(drive, poses)
    heard = heard_waves(learnt.hyperparameters, frame, most, unheard)
    return None if heard is None else replace(learnt, basis=WaveBasis.over(frame, heard))


def learnt_about(
    drive: Drive, poses: list[gtsam.Pose3], most: int, first: WavePrior | None
) -> WavePrior:
    """Learn field and noise at poses, with more waves than a path is solved with.

    A field of too few seems to have its sources near. Parameters as of ``prior_about``.
    """
    frame = box_about(drive, poses)
    wanted = every_wave(frame, most)
    if first is not None:
        wanted = heard_waves(first.hyperparameters, frame, most, LEARNT) or wanted
    return learnt_waves(drive, poses, WaveBasis.over(frame, wanted), first)


def every_wave(frame: TileFrame, most: int) -> Resolution:
    """Return so many of the longest waves of a box, of both sides as many."""
    edge = float(np.sqrt(np.prod(frame.size)))
    return Resolution(np.inf, np.inf).within(most, edge)


def most_waves(drive: Drive, options: WholeFieldOptions) -> int:
    """Return how many waves one field of a drive may have."""
    return min(MOST_WAVES, options.entries // max(len(drive.readings), 1))


@dataclass(frozen=True)
class OneFieldProblem:
    """A drive in one field.

    Attributes
    ----------
    drive
        The drive; its calibrations are as certain as H that may have changed leaves them.
    prior
        Of the field.
    noise
        Of each sensor that counts in uT, shape (S,).
    options
        Loss of the readings.
    """

    drive: Drive
    prior: WavePrior
    noise: FloatArray
    options: SlamOptions

    @classmethod
    def of(
        cls, drive: Drive, prior: WavePrior, noise_factor: float, options: SlamOptions
    ) -> "OneFieldProblem":
        """Return the problem with so many times the noise that is learnt."""
        loose = replace(drive, sensors=drive.sensors.loosened(0.0, prior.offset))
        return cls(loose, prior, noise_factor * prior.noise, options)

    def likeliest(self, estimate: JointEstimate, iterations: int) -> JointEstimate:
        """Return the likeliest path and sensors near an estimate."""
        near = self.near(self.at(estimate))
        errors = likeliest_errors(near, near.errors_from(self.drive.sensors), iterations)
        values = near.moved_values(errors)
        _, moved = near.moved_by(errors[:, None])
        sensors = estimate.sensors.at(near.sensors + moved[:, :, 0])
        return JointEstimate(values, poses_in(values, len(self.drive)), sensors)

    def at(self, estimate: JointEstimate) -> TiledRound:
        """Return the graph at an estimate, with the robust weights of its readings."""
        own = self.drive.sensors.covariance
        sensors = replace(estimate.sensors, covariance=own, noise=self.noise)
        found = self._graph.solved(estimate.poses, sensors, 1.0, CONVEX)
        values = found.values
        values.update(estimate.values)
        return replace(found, values=values, poses=estimate.poses, sensors=sensors)

    def near(self, found: TiledRound) -> PathNeighbourhood:
        """Return the density about an estimate, of its graph there."""
        weights = np.maximum(found.weights, REJECTED_WEIGHT)
        variance = self.noise[self.drive.readings.sensor] ** 2 / weights
        own = replace(self.drive, sensors=found.sensors)
        noise = WhiteInformation(variance)
        return PathNeighbourhood(own, found.poses, found.values, self.prior.field, noise)

    def finished(self, estimate: JointEstimate) -> tuple[FieldSolution, PathInformation]:
        """Return the solution at an estimate, and what readings determine of its path."""
        found = self.at(estimate)
        information = path_information(self.near(found))
        return with_information(self._graph.finished(found), information), information

    @property
    def _graph(self) -> TiledProblem:
        """The graph, which is evaluated only."""
        evaluated = {"calibration": CalibrationUse.REFINED, "max_iterations": 0}
        options = self.options.model_copy(update=evaluated)
        return TiledProblem(self.drive, self.prior.divided, options, weights_last)


def with_gain(
    drive: Drive,
    estimate: JointEstimate,
    prior: WavePrior,
    odometry: list[gtsam.Pose3],
    options: SlamOptions,
) -> FieldSolution:
    """Return the solution at an estimate, with sigmas of its density and what it is worth."""
    found, information = OneFieldProblem.of(drive, prior, LAST.noise_factor, options).finished(
        estimate
    )
    most = most_waves(drive, options.whole_field)
    there, by_odometry = (
        learnt_about(drive, each, most, prior) for each in (estimate.poses, odometry)
    )
    likelier = there.log_likelihood - by_odometry.log_likelihood
    likelier -= found.solution.bent + information.narrowed
    gain = gain_of(estimate.poses, odometry, information, likelier)
    _, p = stacked(estimate.poses)
    near_m = 2 * prior.hyperparameters.floor_depth
    return replace(found, gain=gain, returns=returned(p, drive.steps.path, near_m))

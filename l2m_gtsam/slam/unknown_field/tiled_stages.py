"""A drive in tiles of an unknown field, solved stage by stage.

First the noise of readings is scaled up, so that only the field's long waves matter, and a
revisited place is recognised from further off; then it is reduced. At each stage tiles are laid out
anew at the current poses, and readings that no tile explains lose their weight. Those of the last
stage are larger: they take more time, and connect more of the path.

Odometry drifts out of the reach of the longest waves, too. So the drive is first followed coarsely,
piece by piece: each is initialised by the one before, and where it comes back to is searched for
(:mod:`.return_search`).

Fields are taken to last. Only where a visit then finds another field (:mod:`.revisited_tiles`) is
the drive solved again with tiles that end there, and the likelier of both solutions is kept.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np

from l2m_gtsam.calibration.optimise import TOLERANCE
from l2m_gtsam.data import BoolArray
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.gain import readings_log_likelihood
from l2m_gtsam.slam.unknown_field.return_search import ReturnSearch
from l2m_gtsam.slam.unknown_field.tile_visits import CLEAR
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiled_smoother import (
    AWAY_M,
    Divided,
    FieldSolution,
    TiledProblem,
    TiledRound,
)
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, coarser, larger

FOLLOWED = (16.0, 1.0)  # factor of the readings' noise, convexity of the loss (``solve.robust``)
JUDGED = (4.0, 1.0)  # the same, with which two solutions of a piece are compared
CLOSE = 0.5  # decrease of the error that moves poses by less than their sigmas
# The same stage by stage, and the decrease of the error below which each has converged. Only the
# last has to: all before it to the end took up to twice the time, and moved results by 0.6 mm.
STAGES = (
    (4.0, 1.0, CLOSE),
    (1.0, 1.0, CLOSE),
    (1.0, np.inf, CLOSE),
    (1.0, np.inf, TOLERANCE),
)
FOLLOWED_MODES = 60  # of a tile meanwhile: with so much noise 200 tell no more
PIECE_M = 30.0  # path length over which a drive is followed at once


def map_drive(
    drive: Drive,
    initial: list[gtsam.Pose3],
    prior: FieldPrior,
    options: SlamOptions,
    progress: Progress,
) -> FieldSolution:
    """Estimate the poses of a drive and the field along it.

    Parameters
    ----------
    drive
        The drive.
    initial
        K key poses by odometry and scans.
    prior
        Of the field.
    options
        How to solve.
    progress
        Called with a stage and the fraction of it that is done.
    """
    long_waves = coarser(prior, FOLLOWED_MODES)
    lasting = StagedDrive(drive, prior, long_waves, options, TiledDrive.lasting)
    found = lasting.solved(initial, progress)
    if not finds_changes(found.solution.drive, found.solution.poses, prior):
        return found

    def again(stage: str, done: float) -> None:
        progress(f"{stage}, with moved steel", done)

    # In tiles of few waves many visits seem to find another field.
    division = TiledDrive.renewed
    changed = replace(lasting, followed_in=prior, division=division).solved(initial, again)
    used = found.solution.used | changed.solution.used
    return found if log_density(found, used) > log_density(changed, used) + CLEAR else changed


def finds_changes(drive: Drive, poses: list[gtsam.Pose3], prior: FieldPrior) -> bool:
    """Return whether a visit finds another field than earlier ones, at estimated poses."""
    motions = RelativeMotions.along(drive, poses)
    lasting, renewed = (
        divided(motions, poses, drive.sensors, prior)
        for divided in (TiledDrive.lasting, TiledDrive.renewed)
    )
    return len(renewed.anchoring) > len(lasting.anchoring)


def log_density(found: FieldSolution, used: BoolArray) -> float:
    """Return how likely some readings, poses and scans are, weights integrated out.

    Parameters
    ----------
    found
        A solution.
    used
        Which of its N readings count, shape (N,).
    """
    solution = found.solution
    readings = readings_log_likelihood(found.tiled, solution.drive.sensors, used)
    return readings - solution.bent - 0.5 * float(solution.link_squared.sum())


@dataclass(frozen=True)
class StagedDrive:
    """A drive to be solved in one kind of tiles.

    Attributes
    ----------
    drive, prior, options
        As of ``map_drive``.
    followed_in
        Prior of the tiles in which the drive is followed coarsely.
    division
        Divides the drive into tiles of a prior.
    """

    drive: Drive
    prior: FieldPrior
    followed_in: FieldPrior
    options: SlamOptions
    division: Callable[..., TiledDrive]

    def solved(self, initial: list[gtsam.Pose3], progress: Progress) -> FieldSolution:
        """Return the solution from key poses by odometry and scans."""
        poses, sensors = self.followed(initial, progress), self.drive.sensors
        last_divided = partial(self.division, prior=larger(self.prior))
        for number, (scale, mu, close) in enumerate(STAGES, start=1):
            progress("solving poses and field", (number - 1) / len(STAGES))
            divided = last_divided if number == len(STAGES) else self._divided
            problem = TiledProblem(self.drive, divided, self.options, close=close)
            last = problem.solved(poses, sensors, scale, mu)
            poses, sensors = last.poses, last.sensors
        found = problem.finished(last)
        progress("solving poses and field", 1.0)
        return found

    @property
    def _divided(self) -> Divided:
        return partial(self.division, prior=self.prior)

    def followed(self, initial: list[gtsam.Pose3], progress: Progress) -> list[gtsam.Pose3]:
        """Return the poses solved piece by piece, coarsely."""
        path, noise = self.drive.steps.path, FOLLOWED[0] * self.drive.sensors.noise
        long_waves = coarser(self.prior, FOLLOWED_MODES)
        poses, known, begun = initial, 0, 0
        for end in [*np.arange(PIECE_M, path[-1], PIECE_M), path[-1]]:
            progress("following the drive", float(begun / len(self.drive)))
            count = len(self.drive) if end == path[-1] else int(np.searchsorted(path, end))
            search = ReturnSearch(self.drive.until(count), long_waves, noise, known, begun)
            solved = self._piece(search, poses[:count])
            shift = solved.poses[-1].compose(poses[count - 1].inverse())
            poses = [*solved.poses, *(shift.compose(pose) for pose in poses[count:])]
            returns = solved.tiled.anchoring.returns(path, AWAY_M)
            known, begun = (int(returns[-1]) if len(returns) else 0), count
        return poses

    def _piece(self, search: ReturnSearch, poses: list[gtsam.Pose3]) -> TiledRound:
        """Return the solution from poses by odometry, or from those that are searched for.

        With so much noise two places may look alike, as two corners of a room do: the piece is
        solved from both with less of it, and that one is returned whose solution is likelier then.
        If both solutions are in one place there is nothing to choose.
        """
        coarsely = partial(self.division, prior=self.followed_in)
        problem = TiledProblem(search.drive, coarsely, self.options, close=CLOSE)
        found = problem.solved(poses, search.drive.sensors, *FOLLOWED)
        if (start := search.likeliest(poses)) is poses:
            return found
        other = problem.solved(start, search.drive.sensors, *FOLLOWED)
        if not search.apart(found.poses, other.poses):
            return found
        problem = TiledProblem(search.drive, self._divided, self.options, close=CLOSE)
        finer = replace(search, noise=JUDGED[0] * search.drive.sensors.noise)

        def density(each: TiledRound) -> float:
            judged = problem.solved(each.poses, each.sensors, *JUDGED)
            return finer.density(judged.poses, judged.values)

        return max(found, other, key=density)

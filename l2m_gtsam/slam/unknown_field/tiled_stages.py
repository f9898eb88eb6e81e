"""A drive in tiles of an unknown field, solved stage by stage.

First the noise of readings is scaled up, so that only the field's long waves matter, and a
revisited place is recognised from further off; then it is reduced. At each stage tiles are laid out
anew at the current poses, and readings that no tile explains lose their weight.

Odometry drifts out of the reach of the longest waves, too. So the drive is first followed coarsely,
piece by piece: each is initialised by the one before, and where it comes back to is searched for
(:mod:`.return_search`).

Fields are taken to last. Only where a visit then finds another field (:mod:`.revisited_tiles`) is
the drive solved again with tiles that end there, and the likelier of both solutions is kept.
"""

from functools import partial

import gtsam
import numpy as np

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
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, coarser

# Factor of the readings' noise and convexity of the loss (mu of ``solve.robust``), stage by stage.
COARSE = ((16.0, 1.0), (4.0, 1.0))
FINE = ((1.0, 1.0), (1.0, np.inf), (1.0, np.inf))
CLOSE = 0.5  # decrease of the error in coarse stages that moves poses by less than their sigmas
SEARCH_MODES = 60  # of a tile, for the search: with so much noise 200 tell no more
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
    lasting = partial(TiledDrive.lasting, prior=prior)
    found = solved_in_stages(drive, initial, lasting, prior, options, progress)
    if not finds_changes(found.solution.drive, found.solution.poses, prior):
        return found

    def again(stage: str, done: float) -> None:
        progress(f"{stage}, with moved steel", done)

    renewed = partial(TiledDrive.renewed, prior=prior)
    changed = solved_in_stages(drive, initial, renewed, prior, options, again)
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


def solved_in_stages(
    drive: Drive,
    initial: list[gtsam.Pose3],
    divided: Divided,
    prior: FieldPrior,
    options: SlamOptions,
    progress: Progress,
) -> FieldSolution:
    """Solve a drive; arguments as of ``map_drive``, and how it is divided into tiles."""
    poses = followed(drive, initial, divided, prior, options, progress)
    sensors, count = drive.sensors, len(COARSE) - 1 + len(FINE)
    coarse = TiledProblem(drive, divided, options, close=CLOSE)
    fine = TiledProblem(drive, divided, options)
    stages = [*((coarse, *stage) for stage in COARSE[1:]), *((fine, *stage) for stage in FINE)]
    for number, (problem, scale, mu) in enumerate(stages):
        progress("solving poses and field", number / count)
        solved = problem.solved(poses, sensors, scale, mu)
        poses, sensors = solved.poses, solved.sensors
    found = fine.finished(solved)
    progress("solving poses and field", 1.0)
    return found


def followed(
    drive: Drive,
    initial: list[gtsam.Pose3],
    divided: Divided,
    prior: FieldPrior,
    options: SlamOptions,
    progress: Progress,
) -> list[gtsam.Pose3]:
    """Return the poses of a drive solved piece by piece, coarsely."""
    path, noise = drive.steps.path, COARSE[0][0] * drive.sensors.noise
    long_waves = coarser(prior, SEARCH_MODES)
    poses, known, begun = initial, 0, 0
    for end in np.arange(PIECE_M, path[-1], PIECE_M):
        progress("following the drive", float(end / path[-1]))
        count = int(np.searchsorted(path, end))
        part = drive.until(count)
        search = ReturnSearch(part, long_waves, noise, known, begun)
        solved = likelier_round(
            search, TiledProblem(part, divided, options, close=CLOSE), poses[:count]
        )
        shift = solved.poses[-1].compose(poses[count - 1].inverse())
        poses = [*solved.poses, *(shift.compose(pose) for pose in poses[count:])]
        returns = solved.tiled.anchoring.returns(path, AWAY_M)
        known, begun = (int(returns[-1]) if len(returns) else 0), count
    search = ReturnSearch(drive, long_waves, noise, known, begun)
    return likelier_round(search, TiledProblem(drive, divided, options, close=CLOSE), poses).poses


def likelier_round(
    search: ReturnSearch, problem: TiledProblem, poses: list[gtsam.Pose3]
) -> TiledRound:
    """Return the coarse solution from poses by odometry, or from those that are searched for.

    A place that only looks like the right one is told by what is left of it once all poses have
    moved: the likelier solution is returned.
    """
    starts = [poses] if (other := search.likeliest(poses)) is poses else [poses, other]
    rounds = [problem.solved(start, search.drive.sensors, *COARSE[0]) for start in starts]
    return max(rounds, key=lambda each: search.density(each.poses, each.values))

"""Learning a map's prior together with how wrong the poses of its survey are.

Scales that were learnt for exact poses take what a pass has in common for field: short waves that
are not there. Sizes of the errors, and scales beside them, are found in turns.
"""

from dataclasses import replace

from l2m_gtsam.maps.harmonic.evidence import condition, normal_of
from l2m_gtsam.maps.harmonic.furnish import COARSE
from l2m_gtsam.maps.harmonic.learning import Window, maximise
from l2m_gtsam.maps.harmonic.learnt import HarmonicOptions, Learnt
from l2m_gtsam.maps.harmonic.pose_sizes import FoundPoses, lasting, noise_beside, pose_sizes
from l2m_gtsam.maps.harmonic.representatives import spread_tiles
from l2m_gtsam.maps.harmonic.tile_sums import shared_noise
from l2m_gtsam.maps.harmonic.tiles import Tiles
from l2m_gtsam.maps.survey_poses import SurveyPoses

TURNS = 2  # of sizes, then scales


def with_pose_errors(
    learnt: Learnt, tiles: Tiles, poses: SurveyPoses, options: HarmonicOptions
) -> Learnt | None:
    """Return a map's prior with errors of its poses; None where nothing shows or states any.

    Parameters
    ----------
    learnt, tiles
        For exact poses.
    poses
        What errors do to the readings: a unit of each, or those that are stated.
    options
        Of the map.
    """
    if poses.stated:
        if not poses.duration_stated and not lasting(learnt, tiles, poses):
            return None
        share = noise_beside(learnt, tiles, poses)
        return relearnt(replace(quieter(learnt, share), poses=poses), options)
    if options.hyperparameters is not None:  # with the noise that is given there is nothing to find
        return None
    found, current = pose_sizes(learnt, tiles, poses), learnt
    if found is None:
        return None
    for _ in range(TURNS - 1):
        current = relearnt(beside(current, poses, found), options)
        exact = replace(current, poses=None)
        again = pose_sizes(exact, Tiles(exact), poses, noise_known=True)
        if again is None:  # scales that fit better leave nothing of them
            return None
        found = again
        current = exact
    done = beside(current, poses, found)
    survey = (*done.origin.survey, found.doubt)
    return replace(done, origin=replace(done.origin, survey=survey))


def beside(learnt: Learnt, poses: SurveyPoses, found: FoundPoses) -> Learnt:
    """Return the same with errors of poses; what they explain is no noise."""
    sized = poses.sized(found.sizes, found.lasting_s)
    return replace(quieter(learnt, found.noise), poses=sized)


def quieter(learnt: Learnt, share: float) -> Learnt:
    """Return the same with a share of the noise's variance."""
    of_map = learnt.hyperparameters
    quiet = of_map.model_copy(update={"noise": float(of_map.noise * share**0.5)})
    return replace(learnt, hyperparameters=quiet)


def relearnt(learnt: Learnt, options: HarmonicOptions) -> Learnt:
    """Return the same with scales and depths learnt beside the errors of the poses."""
    if options.hyperparameters is not None:
        return learnt
    members = learnt.members
    some = spread_tiles(learnt.tiling, [len(rows) for rows in members], options.learning.windows)
    end = maximise([window(learnt, tile) for tile in some], learnt.hyperparameters, ("noise",))
    return replace(learnt, hyperparameters=end.hyperparameters)


def window(learnt: Learnt, tile: int) -> Window:
    """Return a tile's readings beside the errors of their poses."""
    rows = learnt.members[tile]
    basis, readings = learnt.basis(tile, rows, COARSE), learnt.readings[rows]
    given = learnt.hyperparameters
    plain = condition(normal_of(basis, readings), basis.prior(given).log_variance, given.noise)
    _, gradient = basis.field_and_gradient(readings.points, plain.mean)
    return Window(basis, normal_of(basis, readings, shared_noise(learnt, rows, gradient)))

"""Localisation of a whole drive in a magnetic map, off line.

The drive is followed from its start, then all poses are solved together by Levenberg-Marquardt:
in rounds, with the weights that the residuals of the last round give each reading (graduated
non-convexity, see ``solve.robust``), at last with the map's errors as variables.
"""

from dataclasses import replace

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.progress import Progress
from l2m_gtsam.slam.changes import LEAST_LEFT, ROUNDS, changed
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.factors import scale_values
from l2m_gtsam.slam.localised import Localised
from l2m_gtsam.slam.online.following import Follower, follow
from l2m_gtsam.slam.options import SlamOptions
from l2m_gtsam.slam.problem import Problem

# Stages of the graduation: the drive was followed, so that no good reading is far off any more.
GRADUATION = (1.0, 10.0, float("inf"), float("inf"))


def localise_drive(
    drive: Drive, field_map: QueryableMap, options: SlamOptions, progress: Progress
) -> Localised:
    """Find the poses of a drive, and its sensors' calibration if that is to be refined."""
    problem = Problem(drive, field_map, options)
    followed = drive.with_scale_as_walk(options.drift.over_m)
    follower = Follower(followed, field_map, options.robust, free=problem.free)
    values = follow(follower, len(drive), progress)
    values.insert(scale_values(drive))
    counts = np.ones(len(drive.readings), dtype=np.bool_)
    for round_, mu in enumerate(GRADUATION):
        progress("solving all poses", round_ / len(GRADUATION))
        solved = problem.solved(values, counts, mu)
        values = solved.values
    whole = solved
    for _ in range(ROUNDS):
        left_out = changed(problem.fit(solved, counts))[drive.readings.key_pose]
        if not (left_out & counts).any():
            break
        counts = counts & ~left_out
        if np.mean(counts) < LEAST_LEFT:  # this is no change of a place, but another one
            solved, counts = whole, np.ones_like(counts)
            break
        solved = problem.solved(solved.values, counts, np.inf)
    progress("solving all poses", 1.0)
    return replace(problem.finished(solved), near_changes=~counts)

"""The pose graph of a drive in the format of g2o."""

from pathlib import Path

import gtsam

from l2m_factors import X
from l2m_gtsam.slam.factors import step_factor
from l2m_gtsam.slam.localised import Localised


def write_g2o(path: Path, solution: Localised) -> None:
    """Write localised key poses as vertices and odometry as edges.

    The format knows no magnetic readings, no prior and no scale: ways are as long as they came
    out. Numbers have six digits, as GTSAM writes them.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for number in range(len(solution.drive.steps)):
        graph.add(step_factor(solution.drive, number, solution.longer))
    for k, pose in enumerate(solution.poses):
        values.insert(X(k), pose)
    gtsam.writeG2o(graph, values, str(path))

"""The prior of an unknown field, learnt where a drive begins."""

import gtsam
import numpy as np

from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import place
from l2m_gtsam.slam.unknown_field.field_prior import FieldPrior, TileOptions, field_prior


def drive_prior(drive: Drive, poses: list[gtsam.Pose3], options: TileOptions) -> FieldPrior:
    """Learn the prior of the field from the first part of a drive, at poses by odometry."""
    way = np.append(0.0, np.cumsum(np.linalg.norm(drive.steps.p, axis=1)))
    early = np.flatnonzero(way[drive.readings.key_pose] <= options.learn_over_m)
    readings = drive.readings[early]
    where = place(
        readings, {int(k): poses[int(k)] for k in np.unique(readings.key_pose)}, drive.sensors
    )
    return field_prior(where.x, where.field(drive.sensors), options)

r"""What errors of a survey's poses do to the readings that a map is made of.

A reading stands for ``x = p + a``, with the lever arm ``a = R t``, and for y, both in the map
frame. A pose that is turned by w and moved by v, ``R_true = Exp(w) R``, gives

.. math::
    dx = [a]_\times w - v, \quad dy = [y]_\times w
"""

import numpy as np

from l2m_gtsam.data import FloatArray, Readings, Trajectory
from l2m_gtsam.maps.survey_poses import POSE, SHIFT, SurveyPoses
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions, pose_roots

SHORTEST_S = 0.01  # stands for errors that do not last


def survey_poses(
    trajectory: Trajectory,
    readings: Readings,
    points: FloatArray,
    field: FloatArray,
    options: PoseNoiseOptions | None,
) -> SurveyPoses | None:
    """Return what errors of the poses do to readings; nothing if they are stated to be exact.

    Parameters
    ----------
    trajectory
        The poses.
    readings
        With the poses at their stamps.
    points, field
        What they stand for in the map frame in m and uT, shapes (N, 3).
    options
        How wrong the poses are.
    """
    options = PoseNoiseOptions() if options is None else options
    if options.position_m == options.rotation_deg == 0:
        return None
    N, R = len(readings), readings.R_map_lidar
    shift = np.zeros((N, SHIFT, POSE))
    shift[:, :3, :3] = crossing(points - readings.p_map_lidar)
    shift[:, :3, 3:] = -np.eye(3)
    shift[:, 3:, :3] = crossing(field)
    roots = pose_roots(trajectory, readings.stamp_ns, options)
    if roots is not None:  # along the axes of the lidar
        shift = shift @ np.concatenate([R @ roots[:, :3], R @ roots[:, 3:]], axis=1)
    seconds = 1e-9 * (readings.stamp_ns - trajectory.stamp_ns[0])
    lasting_s = max(options.lasting_s, SHORTEST_S)
    one_drive = np.zeros(N, dtype=np.int64)
    return SurveyPoses(
        reading=np.arange(N),
        drive=one_drive,
        seconds=seconds,
        shift=shift,
        lasting_s=lasting_s,
        stated=roots is not None,
        duration_stated=options.correlation_s is not None,
    )


def crossing(vectors: FloatArray) -> FloatArray:
    """Return the matrices that take the cross product of vectors, (N, 3), shape (N, 3, 3)."""
    return np.asarray(np.cross(vectors[:, None], np.eye(3)).transpose(0, 2, 1))

"""What errors of a survey's poses and sensors do to the readings that a map is made of."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from l2m_gtsam.data import FloatArray, KnownSensor, Readings, Trajectory
from l2m_gtsam.mapping.suite_likelihood import Undistorted, field_slopes, place_slopes
from l2m_gtsam.maps.suite_errors import SHIFT, SIZE, SuiteErrors
from l2m_gtsam.maps.survey_poses import POSE, SurveyPoses
from l2m_gtsam.recording.pose_noise import PoseNoiseOptions, pose_roots


def suite_errors(
    readings: Readings, known: Sequence[KnownSensor], undone: Undistorted
) -> SuiteErrors:
    """Return what the sensors' errors do to their readings.

    Parameters
    ----------
    readings
        With poses at their stamps and the sensors' time offsets, and with motion.
    known
        The S sensors, in the readings' order; those without a covariance count as exact.
    undone
        The readings as these sensors have them.
    """
    if readings.motion is None:
        raise ValueError("the readings have no motion, so that no clock can be judged")
    of_field = field_slopes(readings, undone.turned, undone.b)
    shift = np.concatenate([place_slopes(readings, undone.lever), of_field], axis=1)
    names, every = tuple(each.sensor for each in known), np.arange(len(readings))
    return SuiteErrors(names, suite_covariance(known), every, readings.sensor, shift)


def suite_covariance(known: Sequence[KnownSensor]) -> FloatArray:
    """Return the covariance of all sensors' errors, shape (16 S, 16 S)."""
    exact = np.zeros((SIZE, SIZE))
    own = [exact if each.covariance is None else each.covariance for each in known]
    ranks = [each.common.shape[1] for each in known if each.common is not None]
    common = np.zeros((len(known), SIZE, max(ranks, default=0)))
    for root, each in zip(common, known, strict=True):
        if each.common is not None:
            root[:, : each.common.shape[1]] = each.common
    together = common.reshape(SIZE * len(known), -1)
    alone = [each - root @ root.T for each, root in zip(own, common, strict=True)]
    return np.asarray(together @ together.T + block_diag(*alone))


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

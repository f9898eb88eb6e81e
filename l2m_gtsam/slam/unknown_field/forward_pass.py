"""A recorded drive followed by a Kalman filter: where the smoother starts."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.odometry import FixedStep
from l2m_gtsam.slam.relative_motion import from_end
from l2m_gtsam.slam.unknown_field.field_filter import NO_DRIFT, FieldFilter, FilterStep
from l2m_gtsam.slam.unknown_field.whole_field import WholeField


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


def followed(drive: Drive, field: WholeField, origin: gtsam.Pose3, largest: float) -> FollowedDrive:
    """Follow a drive.

    Parameters
    ----------
    drive
        Odometry and readings.
    field
        In the frame of the first key pose.
    origin
        The first key pose.
    largest
        Squared Mahalanobis length beyond which a reading does not count.
    """
    follows = FieldFilter(field, drive.sensors, largest)
    state = follows.start()
    poses = [state.pose]
    for step in filter_steps(drive):
        state = follows.after(state, step)
        poses.append(state.pose)
    return FollowedDrive([origin.compose(each) for each in poses], state.log_likelihood)


def filter_steps(drive: Drive) -> Iterator[FilterStep]:
    """Yield the steps of a drive with their readings.

    A steady drift counts as large along all axes as along the largest: none of the filter's axes,
    those of the first key pose, need be vertical.
    """
    steps, key = drive.steps, drive.readings.key_pose
    readings = from_end(drive.readings, steps.R[key], steps.p[key])
    bounds = np.searchsorted(key, np.arange(len(steps) + 1))
    for k in range(len(steps)):
        fixed = steps.fixed_axes
        yield FilterStep(
            drive.step(k),
            steps.covariance[k],
            readings[np.arange(bounds[k], bounds[k + 1])],
            NO_DRIFT if steps.steady is None else steps.steady[k].max(axis=1),
            None if fixed is None else FixedStep(steps.fixed_turns[k], fixed[k]),
        )

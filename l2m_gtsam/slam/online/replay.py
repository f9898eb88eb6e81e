"""A recording as messages in order of time, as they would come on a vehicle."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.slam.online.intake import pose_of
from l2m_gtsam.slam.online.odometry_check import OdometryPose
from l2m_gtsam.slam.online.session import OnlinePose, OnlineSlam


@dataclass(frozen=True)
class FieldReading:
    """A reading of a sensor, with its time and field in uT, shape (3,)."""

    stamp_ns: int
    sensor: str
    field: FloatArray


def messages(recording: Recording, after_ns: int = -1) -> Iterator[OdometryPose | FieldReading]:
    """Yield odometry and readings later than a time, in order of their stamps.

    Parameters
    ----------
    recording
        A drive; its poses are odometry.
    after_ns
        Time in nanoseconds.
    """
    series, odometry = recording.series, recording.trajectory
    stamps = np.concatenate([odometry.stamp_ns, *(each.stamp_ns for each in series)])
    source = np.repeat(np.arange(len(series) + 1), [len(odometry), *map(len, series)])
    row = np.concatenate([np.arange(len(odometry)), *(np.arange(len(each)) for each in series)])
    order = np.lexsort((-source, stamps))  # readings come before a pose of the same time
    for at in order[stamps[order] > after_ns].tolist():
        if source[at] == 0:
            yield pose_of(odometry, int(row[at]))
            continue
        own = series[source[at] - 1]
        yield FieldReading(int(stamps[at]), own.sensor, own.field[row[at]])


def give(slam: OnlineSlam, message: OdometryPose | FieldReading) -> tuple[OnlinePose, ...]:
    """Give a message to a localisation, and return the key poses that it makes."""
    if isinstance(message, OdometryPose):
        return slam.add_odometry(message)
    slam.add_reading(message.stamp_ns, message.sensor, message.field)
    return ()

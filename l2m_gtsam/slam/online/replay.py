"""A recording as messages in order of time, as they would come on a vehicle."""

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from l2m_gtsam.data import FloatArray, Recording
from l2m_gtsam.records.scans import Scan
from l2m_gtsam.slam.online.odometry_pose import OdometryPose, pose_of
from l2m_gtsam.slam.online.online_pose import OnlinePose
from l2m_gtsam.slam.online.session import OnlineSlam


@dataclass(frozen=True)
class FieldReading:
    """A reading of a sensor, with its time and field in uT, shape (3,)."""

    stamp_ns: int
    sensor: str
    field: FloatArray


Message: TypeAlias = OdometryPose | FieldReading | Scan


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


def with_scans(recorded: Iterable[Message], scans: Iterable[Scan]) -> Iterator[Message]:
    """Yield messages and scans in order of their stamps; each of both comes in order."""
    return heapq.merge(recorded, scans, key=lambda each: each.stamp_ns)


def give(slam: OnlineSlam, message: Message) -> tuple[OnlinePose, ...]:
    """Give a message to a localisation, and return the key poses that it makes."""
    if isinstance(message, OdometryPose):
        return slam.add_odometry(message)
    if isinstance(message, Scan):
        slam.add_scan(message)
        return ()
    slam.add_reading(message.stamp_ns, message.sensor, message.field)
    return ()

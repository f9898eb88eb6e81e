"""Drives given to a localisation on line, message by message, and what comes of it."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, KnownSensor, Recording, Trajectory
from l2m_gtsam.slam.online.events import EventKind, OnlineEvent
from l2m_gtsam.slam.online.online_pose import OnlinePose
from l2m_gtsam.slam.online.replay import FieldReading, Message, give
from l2m_gtsam.slam.online.session import OnlineSlam
from l2m_gtsam.slam.options import SlamOptions
from tests.drives.slam import COARSE, SlamDrive, calibrated, small_hall
from tests.support.pose_errors import pose_nees
from tests.worlds.exact import dipole_world

Messages = Iterable[Message]
Hall = tuple[tuple[KnownSensor, ...], SlamDrive]
WORLD, OPTIONS = dipole_world(1), SlamOptions.model_validate({"key_poses": COARSE})


def online_hall() -> Hall:
    """Return two sensors and a drive of 15 m with odometry that slips by 1 % of the path."""
    return small_hall(21, seconds=25.0)


def in_map(hall: Hall) -> OnlineSlam:
    """Return a localisation of such a drive in its map."""
    return OnlineSlam(calibrated(hall[0]), OPTIONS, WORLD)


@dataclass(frozen=True)
class OnlineRun:
    """Key poses as they were known when they were made, and what happened."""

    poses: tuple[OnlinePose, ...]
    events: tuple[OnlineEvent, ...]

    @property
    def kinds(self) -> list[EventKind]:
        return [each.kind for each in self.events]

    def texts(self, kind: EventKind) -> list[str]:
        return [each.text for each in self.events if each.kind is kind]

    def trajectory(self) -> Trajectory:
        """Return the poses in the order of their times."""
        return Trajectory(
            np.array([each.stamp_ns for each in self.poses]),
            np.stack([each.T_map_lidar.R for each in self.poses]),
            np.stack([each.T_map_lidar.t for each in self.poses]),
            "map",
            "lidar",
            np.stack([each.covariance for each in self.poses]),
        )

    def off(self, truth: Trajectory) -> FloatArray:
        """Return how far the positions are off in metres."""
        rows = np.searchsorted(truth.stamp_ns, self.trajectory().stamp_ns)
        return np.asarray(np.linalg.norm(self.trajectory().p - truth.p[rows], axis=1))

    def nees(self, truth: Trajectory) -> FloatArray:
        """Return the normalised squared errors of the poses, six in the mean."""
        rows = np.searchsorted(truth.stamp_ns, self.trajectory().stamp_ns)
        return np.asarray(pose_nees(truth[rows], self.trajectory()))


def driven(slam: OnlineSlam, given: Messages) -> OnlineRun:
    """Give messages to a localisation to their end."""
    poses = [pose for message in given for pose in give(slam, message)]
    last = slam.finish()
    first_ns = last[0].stamp_ns if last else 0
    kept = (each for each in poses if each.stamp_ns < first_ns or not last)
    return OnlineRun((*kept, *last), slam.events())


def with_readings(
    given: Messages, change: Callable[[FieldReading], FieldReading | None]
) -> Iterator[Message]:
    """Yield messages with readings changed, or left out where nothing is returned."""
    for message in given:
        if not isinstance(message, FieldReading):
            yield message
        elif (changed := change(message)) is not None:
            yield changed


def seconds_of(recording: Recording, stamp_ns: int) -> float:
    """Return the time since the first pose of a drive."""
    return 1e-9 * (stamp_ns - int(recording.trajectory.stamp_ns[0]))

"""Calibrations that a drive contradicts, as it is driven, and the sensor that is at fault.

A sensor that was moved draws the poses with it. As off line (:mod:`l2m_gtsam.slam.moved_sensors`)
the drive without it decides, here the path since its start, which is followed again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.errors import CalibrationError
from l2m_gtsam.slam.drive import KnownSensors, StartPose
from l2m_gtsam.slam.moved_sensors import LARGEST, MovedSensor, sensor_to_leave_out
from l2m_gtsam.slam.online.branches import BranchedFollower
from l2m_gtsam.slam.online.key_pose import ArrivedKeyPose
from l2m_gtsam.slam.pose_graph import stated_information_root

KEPT = 150  # key poses since the start that are followed again; each takes some 25 ms
AGAIN = 2.0  # times, by which a contradiction has grown when it is looked at again


@dataclass(frozen=True)
class LeftOut:
    """A sensor that is left out, and the drive followed without it."""

    moved: MovedSensor
    follower: BranchedFollower


class CalibrationWatch:
    """Which calibrations a drive in a map contradicts so far.

    Parameters
    ----------
    given
        Sensors as they were calibrated.
    follower
        Begins to follow a drive.

    Attributes
    ----------
    reported
        Names of the sensors that were found to be contradicted.
    out
        Names of those of them whose readings do not count any more.
    """

    def __init__(
        self, given: KnownSensors, follower: Callable[[StartPose], BranchedFollower]
    ) -> None:
        self._given, self._follower = given, follower
        self._roots = np.stack([stated_information_root(each) for each in given.covariance])
        self.reported: set[str] = set()
        self.out: set[str] = set()
        self._start: StartPose | None = None
        self._key_poses: list[ArrivedKeyPose] = []
        self._tried = LARGEST / AGAIN

    def begun(self, start: StartPose) -> None:
        """Keep where the drive is followed from."""
        self._start, self._key_poses = start, []

    def followed(self, key_pose: ArrivedKeyPose) -> None:
        """Keep a key pose, unless those since the start are too many."""
        if self._start is not None:
            self._key_poses.append(key_pose)
        if len(self._key_poses) > KEPT:
            self._start, self._key_poses = None, []

    def counting(self, key_pose: ArrivedKeyPose) -> ArrivedKeyPose:
        """Return a key pose with the readings that count."""
        for name in self.out:
            key_pose = key_pose.without_sensor(self._given.names.index(name))
        return key_pose

    def refuted(self, refined: KnownSensors) -> list[MovedSensor]:
        """Return the sensors that are contradicted now and were not before."""
        found = [
            MovedSensor(name, change)
            for name, change in self._changes(refined).items()
            if change > LARGEST and name not in self.reported
        ]
        self.reported |= {each.sensor for each in found}
        return found

    def left_out(self, refined: KnownSensors) -> LeftOut | None:
        """Return the sensor without which all others hold, if the drive shows it now."""
        start, changes = self._start, self._changes(refined)
        most = max(changes.values())
        if start is None or most < AGAIN * self._tried:
            return None
        self._tried = most
        followed = dict[str, BranchedFollower]()

        def without(sensor: str) -> dict[str, float]:
            try:
                followed[sensor] = self._followed_without(sensor, start)
            except CalibrationError:  # the others do not place the vehicle
                return {}
            left = self._changes(followed[sensor].belief.known_sensors)
            return {name: change for name, change in left.items() if name != sensor}

        moved = sensor_to_leave_out(changes, without)
        if moved is None:
            return None
        self.reported |= {moved.sensor}
        self.out |= {moved.sensor}
        self._key_poses = [self.counting(each) for each in self._key_poses]
        return LeftOut(moved, followed[moved.sensor])

    def _changes(self, refined: KnownSensors) -> dict[str, float]:
        """Return by how much calibrations changed that count; see ``calibration_changes``."""
        off = refined.vectors() - self._given.vectors()
        white = np.einsum("sij,sj->si", self._roots, off)
        squared = np.einsum("si,si->s", white, white)
        changes = dict(zip(self._given.names, squared.tolist(), strict=True))
        return {name: change for name, change in changes.items() if name not in self.out}

    def _followed_without(self, sensor: str, start: StartPose) -> BranchedFollower:
        follower, number = self._follower(start), self._given.names.index(sensor)
        for each in self._key_poses:
            follower.add(each.without_sensor(number))
        return follower

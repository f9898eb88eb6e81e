"""Readings that hang on key poses, evaluated together and again only when variables change."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import DifferentiableMap, FloatArray
from l2m_factors.key_pose_readings import (
    Calibrations,
    KeyPoseReadings,
    KeyPoseResiduals,
    key_pose_residuals,
)
from l2m_factors.keys import D, S, T
from l2m_factors.residual import ReadingResiduals

LEAST = 5e-324  # GTSAM takes doubles for equal that differ by less than a tolerance


class SensorVariables:
    """The calibrations that readings on key poses depend on.

    Parameters
    ----------
    readings
        N readings; sensor indices count from 0.
    fixed
        Calibrations that are no variables. Without them there are ``T(i)`` and ``D(i)`` of each
        sensor, and ``S(i)`` for readings with motion.

    Attributes
    ----------
    timed
        Whether there are ``S(i)``.
    """

    def __init__(self, readings: KeyPoseReadings, fixed: Calibrations | None) -> None:
        self._sensor, self._fixed = readings.sensor, fixed
        self.timed = fixed is None and readings.motion is not None

    def on(self, rows: npt.NDArray[np.int64]) -> list[int]:
        """Return the sensors of these readings, ascending."""
        return [int(sensor) for sensor in np.unique(self._sensor[rows])]

    def keys(self, sensors: list[int]) -> list[int]:
        """Return the variables of these sensors."""
        if self._fixed is not None:
            return []
        return [key for sensor in sensors for key in self._keys(sensor)]

    def calibrations(self, values: gtsam.Values, sensors: list[int]) -> Calibrations:
        """Return the calibrations of these sensors; zeros for others, and where none is known."""
        if self._fixed is not None:
            return self._fixed
        known = Calibrations.zeros(max(sensors) + 1)
        for sensor in self.known(values, sensors):
            known.t[sensor] = values.atPoint3(T(sensor))
            known.distortion[sensor] = values.atVector(D(sensor))
            if self.timed:
                known.offset[sensor] = values.atDouble(S(sensor))
        return known

    def known(self, values: gtsam.Values, sensors: list[int]) -> list[int]:
        """Return those of these sensors whose calibrations values have: on line, some come late."""
        if self._fixed is not None:
            return sensors
        return [each for each in sensors if values.exists(T(each))]

    def C(self, values: gtsam.Values, rows: npt.NDArray[np.int64]) -> FloatArray:
        """Return the distortion matrix of each of n readings, shape (n, 3, 3)."""
        known = self.calibrations(values, self.on(rows))
        return np.asarray(known.distortion[self._sensor[rows], :9].reshape(-1, 3, 3))

    def jacobians(
        self, seen: ReadingResiduals, rows: npt.NDArray[np.int64], more: FloatArray | None = None
    ) -> list[FloatArray]:
        """Return derivatives by each of ``keys`` of the sensors of n readings, (n, 3, .) each.

        Parameters
        ----------
        seen
            Residuals of all N readings.
        rows
            Which of them.
        more
            What is added to the predicted field in the lidar frame in uT, shape (n, 3).
        """
        if self._fixed is not None:
            return []
        by_D = seen.de_dD[rows]
        if more is not None:
            for axis in range(3):
                by_D[:, axis, 3 * axis : 3 * axis + 3] += more
        parts = [seen.de_dt[rows], by_D, *([seen.de_dS[rows]] if self.timed else [])]
        blocks = []
        for sensor in self.on(rows):
            own = (self._sensor[rows] == sensor)[:, None, None]
            blocks += [np.where(own, part, 0.0) for part in parts]
        return blocks

    def place_keys(self, sensors: list[int]) -> list[int]:
        """Return the positions of these sensors, where they are variables."""
        return [T(sensor) for sensor in sensors] if self._fixed is None else []

    def place_jacobians(self, R: FloatArray, rows: npt.NDArray[np.int64]) -> list[FloatArray]:
        """Return derivatives of places by ``place_keys`` of the sensors of n readings.

        Parameters
        ----------
        R
            Rotations from lidar to the frame of the places, shape (n, 3, 3).
        rows
            The readings.
        """
        if self._fixed is not None:
            return []
        own = [(self._sensor[rows] == sensor)[:, None, None] for sensor in self.on(rows)]
        return [np.where(each, R, 0.0) for each in own]

    def _keys(self, sensor: int) -> list[int]:
        return [T(sensor), D(sensor), *([S(sensor)] if self.timed else [])]


class KeyPoseEvaluation(NamedTuple):
    """All residuals of a batch and the values they are of; stored at once, for several threads.

    Attributes
    ----------
    at
        The variables that the readings depend on.
    residuals
        Of all readings.
    """

    at: gtsam.Values
    residuals: KeyPoseResiduals


class KeyPoseBatch(ABC):
    """What batches of readings on key poses have in common.

    When a factor finds its variables changed, all readings of the batch are evaluated in one query
    of the field. A batch is therefore what is linearised together: a whole drive, or a whole tile,
    for an optimiser that moves all poses at once, one key pose for one that moves few of them
    (iSAM2), which then pays for these alone.

    Parameters
    ----------
    readings
        N readings; sensor indices count from 0.
    fixed
        Calibrations that are no variables. Without them the factors depend on ``T(i)`` and
        ``D(i)`` of each sensor that read at the key pose, and for readings with motion on
        ``S(i)``.

    Raises
    ------
    ValueError
        An array has another shape, a sensor no calibration, or a number is not finite: leave such a
        reading out. The line names it.
    """

    def __init__(self, readings: KeyPoseReadings, fixed: Calibrations | None) -> None:
        readings = readings.checked()
        known = None if fixed is None else fixed.checked(readings.sensor)
        self._readings, self._variables = readings, SensorVariables(readings, known)
        numbers, self._slot = np.unique(readings.key_pose, return_inverse=True)
        self._rows = {int(k): np.flatnonzero(self._slot == n) for n, k in enumerate(numbers)}
        self._sensors = {k: self._variables.on(rows) for k, rows in self._rows.items()}
        self._every_sensor = self._variables.on(np.arange(len(readings)))
        self._asked: dict[int, list[int]] = {}  # keys that readings on a key pose depend on
        self._last: KeyPoseEvaluation | None = None

    def __len__(self) -> int:
        return len(self._readings)

    @property
    def key_poses(self) -> list[int]:
        """Numbers of the key poses that carry readings, ascending."""
        return list(self._rows)

    def rows_of(self, key_pose: int) -> npt.NDArray[np.int64]:
        """Return the indices of the readings on a key pose; a ValueError where there are none."""
        if key_pose not in self._rows:
            raise ValueError(f"key_pose: {key_pose} has no readings; see key_poses of the batch")
        return self._rows[key_pose]

    def residuals(self, values: gtsam.Values, key_pose: int) -> KeyPoseResiduals:
        """Return all residuals, evaluated anew if the variables of this key pose changed.

        Those of key poses without values mean nothing, as when one factor is used alone.
        """
        return self._evaluation(values, self._keys_asked(key_pose)).residuals

    def _evaluation(self, values: gtsam.Values, keys: list[int]) -> KeyPoseEvaluation:
        """Return the last evaluation, or another if any of these variables has changed."""
        last = self._last
        if last is None or not are_same(values, last.at, keys):
            last = KeyPoseEvaluation(self._extracted(values), self._evaluated(values))
            self._last = last
        return last

    @abstractmethod
    def _pose(self, values: gtsam.Values, key_pose: int) -> gtsam.Pose3:
        """Return a key pose in the frame of the field."""

    @abstractmethod
    def _is_present(self, values: gtsam.Values, key_pose: int) -> bool:
        """Return whether values have what ``_pose`` needs."""

    @abstractmethod
    def _field(self, values: gtsam.Values) -> DifferentiableMap:
        """Return the field."""

    @abstractmethod
    def _own_keys(self, key_poses: list[int]) -> list[int]:
        """Return the variables on which readings on key poses depend, but those of sensors."""

    def _keys_asked(self, key_pose: int) -> list[int]:
        if key_pose not in self._asked:
            of_sensors = self._variables.keys(self._sensors[key_pose])
            self._asked[key_pose] = [*self._own_keys([key_pose]), *of_sensors]
        return self._asked[key_pose]

    @cached_property
    def _every_key(self) -> list[int]:
        of_sensors = self._variables.keys(self._every_sensor)
        return [*self._own_keys(list(self._rows)), *of_sensors]

    def _extracted(self, values: gtsam.Values) -> gtsam.Values:
        """Return all variables that the readings depend on, as far as they are there.

        On line some sensors come late, and a factor may be asked alone.
        """
        try:
            return values.extract(self._every_key)
        except RuntimeError:
            return values.extract([key for key in self._every_key if values.exists(key)])

    def _evaluated(self, values: gtsam.Values) -> KeyPoseResiduals:
        return key_pose_residuals(
            self._readings, self._field(values), *self._evaluation_point(values)
        )

    def _evaluation_point(
        self, values: gtsam.Values
    ) -> tuple[FloatArray, FloatArray, Calibrations]:
        """Return the key pose of each reading, (N, 3, 3) and (N, 3) in metres, and the sensors."""
        R, p = np.tile(np.eye(3), (len(self._rows), 1, 1)), np.zeros((len(self._rows), 3))
        slots = {k: slot for slot, k in enumerate(self._rows)}
        for k in self._rows:
            if not self._is_present(values, k):
                continue
            pose = self._pose(values, k)
            R[slots[k]], p[slots[k]] = pose.rotation().matrix(), pose.translation()
        sensors = self._variables.calibrations(values, self._every_sensor)
        return R[self._slot], p[self._slot], sensors


def are_same(values: gtsam.Values, others: gtsam.Values, keys: list[int]) -> bool:
    """Return whether others have variables with the same values.

    Two calls of GTSAM take a twentieth of what asking for one variable after the other takes.

    Raises
    ------
    RuntimeError
        A variable has no value.
    """
    own = values.extract(keys)
    try:
        return bool(own.equals(others.extract(keys), LEAST))
    except RuntimeError:  # others have not all of them
        return False

"""The calibrations of sensors as variables of factors on key poses, or as constants of them."""

import struct

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import FloatArray
from l2m_factors.key_pose_readings import Calibrations, KeyPoseReadings
from l2m_factors.keys import D, S, T
from l2m_factors.residual import ReadingResiduals


class SensorVariables:
    """The calibrations that readings on key poses depend on.

    Parameters
    ----------
    readings
        N readings; sensor indices count from 0.
    fixed
        Calibrations that are no variables. Without them there are ``T(i)`` and ``D(i)`` of each
        sensor, and ``S(i)`` for readings with motion.
    """

    def __init__(self, readings: KeyPoseReadings, fixed: Calibrations | None) -> None:
        self._sensor, self._fixed = readings.sensor, fixed
        self._timed = fixed is None and readings.motion is not None

    def on(self, rows: npt.NDArray[np.int64]) -> list[int]:
        """Return the sensors of these readings, ascending."""
        return [int(sensor) for sensor in np.unique(self._sensor[rows])]

    def keys(self, sensors: list[int]) -> list[int]:
        """Return the variables of these sensors."""
        if self._fixed is not None:
            return []
        return [key for sensor in sensors for key in self._keys(sensor)]

    def stamp(self, values: gtsam.Values, sensors: list[int]) -> bytes:
        """Return the values of these sensors as bytes, which compare faster than arrays."""
        parts = []
        for sensor in sensors if self._fixed is None else []:
            parts += [values.atPoint3(T(sensor)).tobytes(), values.atVector(D(sensor)).tobytes()]
            if self._timed:
                parts.append(struct.pack("d", values.atDouble(S(sensor))))
        return b"".join(parts)

    def calibrations(self, values: gtsam.Values, sensors: list[int]) -> Calibrations:
        """Return the calibrations of these sensors; zeros for others, and where none is known."""
        if self._fixed is not None:
            return self._fixed
        known = Calibrations.zeros(max(sensors) + 1)
        for sensor in sensors:
            if values.exists(T(sensor)):
                known.t[sensor] = values.atPoint3(T(sensor))
                known.distortion[sensor] = values.atVector(D(sensor))
                if self._timed:
                    known.offset[sensor] = values.atDouble(S(sensor))
        return known

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
        parts = [seen.de_dt[rows], by_D, *([seen.de_dS[rows]] if self._timed else [])]
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
        return [T(sensor), D(sensor), *([S(sensor)] if self._timed else [])]

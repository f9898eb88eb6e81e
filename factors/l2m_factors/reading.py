"""Magnetic readings as GTSAM factors: one factor per reading, or one per sensor.

GTSAM asks every factor for its error separately. The numbers come out of one evaluation of all
readings, made when the first factor of a linearisation asks and kept until a variable changes.
"""

import struct
from typing import NamedTuple, TypeAlias

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import covered, index, noise_of, numbers, of_shape
from l2m_factors.field_map import DifferentiableMap, FloatArray, Jacobians
from l2m_factors.keys import D, S, T
from l2m_factors.residual import MagneticReadings, ReadingResiduals, reading_residuals

Rows: TypeAlias = npt.NDArray[np.int64] | slice


class ReadingEvaluation(NamedTuple):
    """All residuals of a batch and the values they are of; stored at once, for several threads.

    Attributes
    ----------
    seen
        Of each sensor its values as bytes.
    residuals
        Of all readings.
    """

    seen: dict[int, bytes]
    residuals: ReadingResiduals


class BatchedReadings:
    """Readings of several sensors over one map, evaluated together.

    Parameters
    ----------
    field_map
        The map.
    readings
        N readings; sensor indices count from 0. With motion the factors depend on the time
        offsets ``S(i)``.
    distortion
        Fixed distortions (C row by row, H in uT), shape (S, 12). Without it the factors depend on
        ``D(i)``; they always do on ``T(i)``.

    Raises
    ------
    ValueError
        An array has another shape, a sensor no distortion, or a number is not finite: leave such a
        reading out. The line names it.
    """

    def __init__(
        self,
        field_map: DifferentiableMap,
        readings: MagneticReadings,
        distortion: FloatArray | None = None,
    ) -> None:
        self._map = field_map
        self._readings = readings = readings.checked()
        self._fixed = None if distortion is None else _held(distortion, readings)
        self._sensors = [int(s) for s in np.unique(readings.sensor)]
        self._timed = readings.motion is not None
        self._keys = {s: self._variables(s) for s in self._sensors}
        self._last: ReadingEvaluation | None = None
        self._derived: tuple[ReadingResiduals, FloatArray] | None = None

    def __len__(self) -> int:
        return len(self._readings)

    @property
    def sensors(self) -> list[int]:
        """Sensors that made at least one reading."""
        return self._sensors

    def sensor_of(self, reading: int) -> int:
        """Return the sensor that made this reading."""
        return int(self._readings.sensor[reading])

    def sensors_of(self, rows: npt.NDArray[np.int64]) -> list[int]:
        """Return the sensors that made some readings; a ValueError where there is no such row."""
        index("rows", int(rows.max(initial=0)), len(self))
        return [int(each) for each in np.unique(self._readings.sensor[rows])]

    def rows_of(self, sensor: int) -> npt.NDArray[np.int64]:
        """Return the indices of this sensor's readings."""
        return np.flatnonzero(self._readings.sensor == sensor)

    def keys_of(self, sensor: int) -> list[int]:
        """Return the keys that this sensor's factors depend on."""
        return self._keys[sensor]

    def residuals(
        self, values: gtsam.Values, sensor: int, stamp: bytes | None = None
    ) -> ReadingResiduals:
        """Return the residuals of all readings, evaluated anew if this sensor's values changed.

        Parameters
        ----------
        values
            Of all variables.
        sensor
            Whose values are compared with those of the last evaluation.
        stamp
            These, if the caller knows them.
        """
        stamp = self.stamp(values, sensor) if stamp is None else stamp
        last = self._last
        if last is None or last.seen.get(sensor) != stamp:
            self._last = last = self._evaluated(values)
        return last.residuals

    def jacobians(self, residuals: ReadingResiduals) -> list[FloatArray]:
        """Return the derivatives by each of ``keys_of``, each of shape (N, 3, .)."""
        by_D = [residuals.de_dD] if self._fixed is None else []
        return [residuals.de_dt, *by_D, *([residuals.de_dS] if self._timed else [])]

    def white_jacobians(
        self, residuals: ReadingResiduals, rows: Rows, W: FloatArray
    ) -> list[FloatArray]:
        """Return the derivatives of ``W e`` of some readings by each of ``keys_of``, (3 n, .).

        Parameters
        ----------
        residuals
            Of all readings.
        rows
            Which ones, n of them.
        W
            What makes their residuals white, in 1/uT, shape (n, 3, 3).
        """
        parts = [W @ residuals.de_dt[rows]]
        if self._fixed is None:
            # W (I kron b^T): nine products for each reading instead of a matrix full of zeros.
            by_C = W[:, :, :, None] * residuals.b_lidar[rows, None, None]
            parts.append(np.concatenate([by_C.reshape(-1, 3, 9), W], axis=2))
        if self._timed:
            parts.append(W @ residuals.de_dS[rows])
        return [part.reshape(3 * len(W), -1) for part in parts]

    @property
    def widths(self) -> list[int]:
        """Numbers of parameters of each of ``keys_of``."""
        return [3, *([12] if self._fixed is None else []), *([1] if self._timed else [])]

    def jacobian(self, residuals: ReadingResiduals) -> FloatArray:
        """Return the derivatives by all parameters of a sensor, shape (N, 3, sum of widths)."""
        derived = self._derived
        if derived is None or derived[0] is not residuals:
            derived = residuals, np.concatenate(self.jacobians(residuals), axis=2)
            self._derived = derived
        return derived[1]

    def stamp(self, values: gtsam.Values, sensor: int) -> bytes:
        """Return the sensor's values as bytes, which compare faster than arrays.

        They are those of ``keys_of``, one after the other.
        """
        keys = self._keys[sensor]  # making a key anew takes as long as reading its value
        stamp: bytes = values.atPoint3(keys[0]).tobytes()
        if self._fixed is None:
            stamp += values.atVector(keys[1]).tobytes()
        return stamp + struct.pack("d", values.atDouble(keys[-1])) if self._timed else stamp

    def _variables(self, sensor: int) -> list[int]:
        distortion = [D(sensor)] if self._fixed is None else []
        return [T(sensor), *distortion, *([S(sensor)] if self._timed else [])]

    def _evaluated(self, values: gtsam.Values) -> ReadingEvaluation:
        # A sensor without values, as when one factor is used alone, is evaluated at zero; nobody
        # asks for it, because its stamp is not kept.
        count = self._sensors[-1] + 1
        t, offset = np.zeros((count, 3)), np.zeros(count) if self._timed else None
        distortion = np.zeros((count, 12)) if self._fixed is None else self._fixed
        present = [s for s in self._sensors if values.exists(T(s))]
        for sensor in present:
            t[sensor] = values.atPoint3(T(sensor))
            if self._fixed is None:
                distortion[sensor] = values.atVector(D(sensor))
            if offset is not None:
                offset[sensor] = values.atDouble(S(sensor))
        seen = {sensor: self.stamp(values, sensor) for sensor in present}
        found = reading_residuals(self._readings, self._map, t, distortion, offset)
        return ReadingEvaluation(seen, found)


def reading_factor(
    batch: BatchedReadings, reading: int, noise_model: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """Return the factor of one reading.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    reading
        Index of the reading in the batch.
    noise_model
        Noise of its three axes in microtesla; any Gaussian or robust model.

    Raises
    ------
    ValueError
        The batch has no such reading, or the noise is not of three components.
    """
    sensor = batch.sensor_of(index("reading", reading, len(batch)))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        residuals = batch.residuals(values, sensor)
        if jacobians is not None:
            for slot, jacobian in enumerate(batch.jacobians(residuals)):
                jacobians[slot] = jacobian[reading]
        return np.asarray(residuals.residual[reading])

    return gtsam.CustomFactor(noise_of(noise_model, 3), batch.keys_of(sensor), error)


def block_factor(batch: BatchedReadings, sensor: int, whitening: FloatArray) -> gtsam.CustomFactor:
    """Return one factor for all readings of one sensor: the same mathematics, less overhead.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    sensor
        Index of the sensor.
    whitening
        For each reading of the batch the matrix W that makes the noise of ``W e`` white with unit
        variance, in 1/uT, shape (N, 3, 3).

    Raises
    ------
    ValueError
        The sensor has no reading, or the whitening another shape.
    """
    own = batch.rows_of(sensor)
    if not len(own):
        raise ValueError(f"sensor: {sensor} has no reading; of {batch.sensors} there are some")
    of_shape("whitening", whitening, (len(batch), 3, 3))
    rows, W = _span(own), numbers("whitening", whitening[own], (len(own), 3, 3))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        residuals = batch.residuals(values, sensor)
        if jacobians is not None:
            for slot, jacobian in enumerate(batch.white_jacobians(residuals, rows, W)):
                jacobians[slot] = jacobian
        return np.asarray(np.einsum("nij,nj->ni", W, residuals.residual[rows]).ravel())

    unit = gtsam.noiseModel.Unit.Create(3 * len(W))
    return gtsam.CustomFactor(unit, batch.keys_of(sensor), error)


def _held(distortion: FloatArray, readings: MagneticReadings) -> FloatArray:
    """Return a copy of fixed distortions, shape (S, 12)."""
    covered("distortions", len(distortion), readings.sensor)
    return numbers("distortion", distortion, (len(distortion), 12))


def _span(rows: npt.NDArray[np.int64]) -> Rows:
    """Return rows that follow each other as a slice, which copies nothing."""
    if len(rows) and rows[-1] - rows[0] == len(rows) - 1:
        return slice(int(rows[0]), int(rows[-1]) + 1)
    return rows

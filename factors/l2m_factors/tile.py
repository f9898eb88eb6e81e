r"""Magnetic readings in a field that is not known: a tile's weights ``M(b)`` are variables.

A tile is fixed to a key pose, its anchor ``X(a)``, and says the field in the anchor's frame as a
sum of features. With ``T = X(a)^{-1} X(k)`` and a reading that hangs on ``X(k)`` by (R, p)

.. math::
    x = T (R t + p), \quad B(x) = F(x) u, \quad e = C (R_T R)^T F(x) u + H - z

    \partial e / \partial u = C (R_T R)^T F(x), \quad
    \partial e / \partial X(a) = -\partial e / \partial X(k) \, Ad(T^{-1})

The derivative by ``X(k)`` is that of ``carried`` with T as the key pose. Fixed to a pose and not to
the map, a tile moves with the vehicle's way when a loop closes, and its prior says nothing of
where in the map it is: one that were fixed there would take a place with more steel than usual for
a lower one.
"""

from typing import Protocol

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.carried import Calibrations, CarriedReadings, CarriedResiduals, carried_residuals
from l2m_factors.field_map import FloatArray
from l2m_factors.keys import M, X
from l2m_factors.sensor_variables import SensorVariables
from l2m_factors.shared_errors import whitened


class TileField(Protocol):
    """A field that is linear in m weights."""

    def features(self, points: FloatArray, /) -> FloatArray:
        """Return the field of each weight at points (N, 3) in metres, uT, shape (N, 3, m)."""
        ...

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray, /
    ) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m, of weights of shape (m,)."""
        ...


class WeightedField:
    """A tile's field with weights that are given: a ``FieldMap`` in the anchor's frame."""

    def __init__(self, tile: TileField, weights: FloatArray) -> None:
        self._tile, self._weights = tile, weights

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        return self._tile.field_and_gradient(points, self._weights)


class TileBatch:
    """Readings on key poses in one tile, evaluated together; see ``CarriedBatch``.

    Parameters
    ----------
    number
        b, of the tile.
    anchor
        a, the key pose that the tile is fixed to.
    field
        What the weights mean.
    readings
        N readings; sensor indices count from 0.
    fixed
        Calibrations that are no variables; without them as in ``CarriedBatch``.
    """

    def __init__(
        self,
        number: int,
        anchor: int,
        field: TileField,
        readings: CarriedReadings,
        fixed: Calibrations | None = None,
    ) -> None:
        self._number, self._anchor, self._field, self._readings = number, anchor, field, readings
        self._variables = SensorVariables(readings, fixed)
        numbers, self._slot = np.unique(readings.key_pose, return_inverse=True)
        self._rows = {int(k): np.flatnonzero(self._slot == n) for n, k in enumerate(numbers)}
        self._sensors = {k: self._variables.on(rows) for k, rows in self._rows.items()}
        self._seen: dict[int, bytes] = {}
        self._residuals: CarriedResiduals | None = None

    def __len__(self) -> int:
        return len(self._readings)

    @property
    def key_poses(self) -> list[int]:
        """Numbers of the key poses that carry readings, ascending."""
        return list(self._rows)

    def rows_of(self, key_pose: int) -> npt.NDArray[np.int64]:
        """Return the indices of the readings on a key pose."""
        return self._rows[key_pose]

    def keys_of(self, key_pose: int) -> list[int]:
        """Return the keys that the readings on a key pose depend on.

        At the anchor the readings know nothing of its pose.
        """
        poses = [] if key_pose == self._anchor else [X(key_pose), X(self._anchor)]
        return [*poses, M(self._number), *self._variables.keys(self._sensors[key_pose])]

    def residuals(self, values: gtsam.Values, key_pose: int) -> CarriedResiduals:
        """Return all residuals, evaluated anew if the variables of this key pose changed.

        Those of key poses without values mean nothing, as when one factor is used alone.
        """
        stamp = self._stamp(values, key_pose)
        if self._residuals is None or self._seen.get(key_pose) != stamp:
            self._residuals = self._evaluated(values)
            self._seen = {k: self._stamp(values, k) for k in self._present(values)}
        return self._residuals

    def jacobians(
        self, residuals: CarriedResiduals, values: gtsam.Values, key_pose: int
    ) -> list[FloatArray]:
        """Return derivatives by each of ``keys_of`` of n readings, each of shape (n, 3, .)."""
        rows, relative = self._rows[key_pose], self._relative(values, key_pose)
        by_sensors = self._variables.jacobians(residuals.reading, rows)
        blocks = [self._by_weights(values, relative, rows), *by_sensors]
        if key_pose == self._anchor:
            return blocks
        by_key = residuals.de_dX[rows]
        return [by_key, -by_key @ relative.inverse().AdjointMap(), *blocks]

    def _by_weights(
        self, values: gtsam.Values, relative: gtsam.Pose3, rows: npt.NDArray[np.int64]
    ) -> FloatArray:
        readings = self._readings[rows]
        known = self._variables.calibrations(values, self._variables.on(rows))
        R_key_lidar, p = readings.lidar_at(known.offset)
        R = relative.rotation().matrix() @ R_key_lidar
        t_key = np.einsum("nij,nj->ni", R_key_lidar, known.t[readings.sensor]) + p
        x = t_key @ relative.rotation().matrix().T + relative.translation()
        C = known.distortion[readings.sensor, :9].reshape(-1, 3, 3)
        return np.asarray(C @ R.transpose(0, 2, 1) @ self._field.features(x))

    def _present(self, values: gtsam.Values) -> list[int]:
        return [k for k in self._rows if k == self._anchor or values.exists(X(k))]

    def _relative(self, values: gtsam.Values, key_pose: int) -> gtsam.Pose3:
        """Return the key pose in the anchor's frame."""
        if key_pose == self._anchor:
            return gtsam.Pose3()
        return values.atPose3(X(self._anchor)).between(values.atPose3(X(key_pose)))

    def _stamp(self, values: gtsam.Values, key_pose: int) -> bytes:
        own = values.atVector(M(self._number)).tobytes()
        if key_pose != self._anchor:
            own += values.atPose3(X(self._anchor)).matrix().tobytes()
            own += values.atPose3(X(key_pose)).matrix().tobytes()
        return own + self._variables.stamp(values, self._sensors[key_pose])

    def _evaluated(self, values: gtsam.Values) -> CarriedResiduals:
        R, p = np.tile(np.eye(3), (len(self._rows), 1, 1)), np.zeros((len(self._rows), 3))
        present = set(self._present(values))
        for slot, k in enumerate(self._rows):
            if k in present:
                pose = self._relative(values, k)
                R[slot], p[slot] = pose.rotation().matrix(), pose.translation()
        sensors = self._variables.calibrations(values, self._variables.on(np.arange(len(self))))
        field = WeightedField(self._field, values.atVector(M(self._number)))
        return carried_residuals(self._readings, field, R[self._slot], p[self._slot], sensors)


def tile_factor(batch: TileBatch, key_pose: int, whitening: FloatArray) -> gtsam.CustomFactor:
    """Return one factor for the readings of all sensors on a key pose in an unknown field.

    It is on ``X(k)``, the anchor ``X(a)``, the weights ``M(b)``, and on the calibrations unless
    the batch has them fixed.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    key_pose
        Number k of the key pose.
    whitening
        For each of its n readings the matrix W that makes the noise of ``W e`` white with unit
        variance, in 1/uT, shape (n, 3, 3).
    """
    rows = batch.rows_of(key_pose)

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        residuals = batch.residuals(values, key_pose)
        if jacobians is not None:
            for slot, block in enumerate(batch.jacobians(residuals, values, key_pose)):
                jacobians[slot] = whitened(whitening, block)
        return whitened(whitening, residuals.reading.residual[rows][:, :, None]).ravel()

    noise = gtsam.noiseModel.Unit.Create(3 * len(rows))
    return gtsam.CustomFactor(noise, batch.keys_of(key_pose), error)

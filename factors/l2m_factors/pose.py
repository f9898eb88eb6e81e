"""Magnetic readings on an estimated ``Pose3``, ``X(k)``, as GTSAM factors: one per key pose."""

from collections.abc import Sequence

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.carried import Calibrations, CarriedReadings, CarriedResiduals, carried_residuals
from l2m_factors.field_map import FieldMap, FloatArray
from l2m_factors.keys import X
from l2m_factors.sensor_variables import SensorVariables
from l2m_factors.shared_errors import SharedError, shared_error, whitened


class CarriedBatch:
    """Readings on key poses over one map, evaluated together.

    When a factor finds its variables changed, all readings of the batch are evaluated in one query
    of the map. A batch is therefore what is linearised together: a whole drive for an optimiser
    that moves all poses at once, one key pose for one that moves few of them (iSAM2), which then
    pays for these alone.

    Parameters
    ----------
    field_map
        The map.
    readings
        N readings; sensor indices count from 0.
    fixed
        Calibrations that are no variables. Without them the factors depend on ``T(i)`` and
        ``D(i)`` of each sensor that read at the key pose, and for readings with motion on
        ``S(i)``.
    """

    def __init__(
        self, field_map: FieldMap, readings: CarriedReadings, fixed: Calibrations | None = None
    ) -> None:
        self._map, self._readings = field_map, readings
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
        """Return the keys that the readings on a key pose depend on."""
        return [X(key_pose), *self._variables.keys(self._sensors[key_pose])]

    def residuals(self, values: gtsam.Values, key_pose: int) -> CarriedResiduals:
        """Return all residuals, evaluated anew if the variables of this key pose changed.

        Those of key poses without values mean nothing, as when one factor is used alone.
        """
        stamp = self._stamp(values, key_pose)
        if self._residuals is None or self._seen.get(key_pose) != stamp:
            self._residuals = self._evaluated(values)
            present = [k for k in self._rows if values.exists(X(k))]
            self._seen = {k: self._stamp(values, k) for k in present}
        return self._residuals

    def jacobians(
        self, residuals: CarriedResiduals, key_pose: int, more: FloatArray
    ) -> list[FloatArray]:
        """Return derivatives by each of ``keys_of``, each of shape (n, 3, .).

        Parameters
        ----------
        residuals
            Of all readings.
        key_pose
            Whose n readings.
        more
            What shared errors add to the field in the lidar frame in uT, shape (n, 3).
        """
        rows = self._rows[key_pose]
        by_sensors = self._variables.jacobians(residuals.reading, rows, more)
        return [residuals.de_dX[rows], *by_sensors]

    def C(self, values: gtsam.Values, key_pose: int) -> FloatArray:
        """Return the distortion matrix of each reading on a key pose, shape (n, 3, 3)."""
        return self._variables.C(values, self._rows[key_pose])

    def _stamp(self, values: gtsam.Values, key_pose: int) -> bytes:
        own = values.atPose3(X(key_pose)).matrix().tobytes()
        return own + self._variables.stamp(values, self._sensors[key_pose])

    def _evaluated(self, values: gtsam.Values) -> CarriedResiduals:
        R, p = np.tile(np.eye(3), (len(self._rows), 1, 1)), np.zeros((len(self._rows), 3))
        for slot, k in enumerate(self._rows):
            if values.exists(X(k)):
                pose = values.atPose3(X(k))
                R[slot], p[slot] = pose.rotation().matrix(), pose.translation()
        sensors = self._variables.calibrations(values, self._variables.on(np.arange(len(self))))
        return carried_residuals(self._readings, self._map, R[self._slot], p[self._slot], sensors)


def key_pose_factor(
    batch: CarriedBatch,
    key_pose: int,
    whitening: FloatArray,
    errors: Sequence[SharedError] = (),
) -> gtsam.CustomFactor:
    """Return one factor for the readings of all sensors on a key pose.

    It is on ``X(k)``, on the calibrations unless the batch has them fixed, and on the weights of
    the errors.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    key_pose
        Number k of the key pose.
    whitening
        For each of its n readings the matrix W that makes the noise of ``W e`` white with unit
        variance, in 1/uT, shape (n, 3, 3).
    errors
        What its readings share with others, as of ``uncertain_block_factor``.
    """
    rows = batch.rows_of(key_pose)
    keys = [*batch.keys_of(key_pose), *(each.key for each in errors)]

    def error(
        _: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        residuals = batch.residuals(values, key_pose)
        e, more = residuals.reading.residual[rows], np.zeros((len(rows), 3))
        C = batch.C(values, key_pose) if errors else np.empty(0)
        if errors:
            more = shared_error(errors, values)
            e = e + np.einsum("nij,nj->ni", C, more)
        if jacobians is not None:
            blocks = batch.jacobians(residuals, key_pose, more)
            blocks += [C @ each.features for each in errors]
            for slot, block in enumerate(blocks):
                jacobians[slot] = whitened(whitening, block)
        return whitened(whitening, e[:, :, None]).ravel()

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3 * len(rows)), keys, error)

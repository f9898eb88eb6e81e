"""Magnetic readings on an estimated ``Pose3`` as GTSAM factors: one per ``X(k)``, or any pose."""

from collections.abc import Sequence

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import indices, noise_of
from l2m_factors.field_map import DifferentiableMap, FloatArray, Jacobians
from l2m_factors.key_pose_batch import KeyPoseBatch
from l2m_factors.key_pose_readings import (
    Calibrations,
    KeyPoseReadings,
    KeyPoseResiduals,
    key_pose_residuals,
)
from l2m_factors.keys import X
from l2m_factors.shared_errors import SharedError, shared_error
from l2m_factors.step import Slots, StepError
from l2m_factors.whitening import Whitening


class MapBatch(KeyPoseBatch):
    """Readings on key poses over one map.

    Parameters
    ----------
    field_map
        The map.
    readings, fixed
        As of ``KeyPoseBatch``.
    """

    def __init__(
        self,
        field_map: DifferentiableMap,
        readings: KeyPoseReadings,
        fixed: Calibrations | None = None,
    ) -> None:
        super().__init__(readings, fixed)
        self._map = field_map

    def keys_of(self, key_pose: int) -> list[int]:
        """Return the keys that the readings on a key pose depend on."""
        return [X(key_pose), *self._variables.keys(self._sensors[key_pose])]

    def jacobians(
        self, residuals: KeyPoseResiduals, key_pose: int, more: FloatArray
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

    def _pose(self, values: gtsam.Values, key_pose: int) -> gtsam.Pose3:
        return values.atPose3(X(key_pose))

    def _is_present(self, values: gtsam.Values, key_pose: int) -> bool:
        return bool(values.exists(X(key_pose)))

    def _field(self, values: gtsam.Values) -> DifferentiableMap:
        return self._map

    def _own_keys(self, key_poses: list[int]) -> list[int]:
        return [X(k) for k in key_poses]


def key_pose_factor(
    batch: MapBatch,
    key_pose: int,
    whitening: Whitening,
    errors: Sequence[SharedError] = (),
    step: StepError | None = None,
) -> gtsam.CustomFactor:
    """Return one factor for the readings of all sensors on a key pose.

    It is on ``X(k)``, on the calibrations unless the batch has them fixed, on the weights of the
    errors, and, if its readings are known to lie between two key poses, on ``X(k+1)``.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    key_pose
        Number k of the key pose.
    whitening
        Of its n readings.
    errors
        What its readings share with others, as of ``uncertain_block_factor``.
    step
        What the error of the step to the next key pose adds to them; nothing without.

    Raises
    ------
    ValueError
        There are no readings on the key pose, or an array is of another number of readings.
    """
    rows = batch.rows_of(key_pose)
    n = len(rows)
    whitening, errors = whitening.checked(n), [each.checked(n) for each in errors]
    terms = [] if step is None else [step.checked(n)]
    of_errors = [each.key for each in errors]
    of_steps = [key for each in terms for key in each.keys]
    slots = Slots([*batch.keys_of(key_pose), *of_errors, *of_steps])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        residuals = batch.residuals(values, key_pose)
        e, more = residuals.reading.residual[rows], np.zeros((len(rows), 3))
        C = batch.C(values, key_pose) if errors else np.empty(0)
        if errors:
            more = shared_error(errors, values)
            e = e + np.einsum("nij,nj->ni", C, more)
        for each in terms:
            e = e + each.residual(values)
        if jacobians is not None:
            blocks = batch.jacobians(residuals, key_pose, more)
            blocks += [C @ each.features for each in errors]
            blocks += [block for each in terms for block in each.jacobians(values)]
            slots.fill(jacobians, whitening, blocks)
        return whitening(e[:, :, None]).ravel()

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(3 * len(rows)), slots.keys, error)


def magnetic_pose_factor(
    key: int,
    field_map: DifferentiableMap,
    sensors: Calibrations,
    sensor: npt.NDArray[np.int64],
    field: FloatArray,
    noise: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:
    """Return one factor of readings that were taken at a pose, with known calibrations.

    It may be the pose of anything: sensors are placed in its frame, whatever ``t`` they have there.

    Parameters
    ----------
    key
        Of the pose in the frame of the map: Pose3, metres.
    field_map
        The map.
    sensors
        Calibrations of the sensors, in the frame of the pose.
    sensor, field
        Index of the sensor of each reading, and what it read in uT, shapes (n,) and (n, 3).
    noise
        Of the n readings one after the other, 3n components in uT.

    Raises
    ------
    ValueError
        An array or the noise has another shape, a sensor no calibration, or a number is not finite:
        leave such a reading out. The line names it.
    """
    sensor = indices("sensor", sensor)
    n = len(sensor)
    here = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3))
    at = KeyPoseReadings(np.zeros(n, dtype=np.int64), sensor, *here, np.zeros(n), field)
    readings, known = at.checked(), sensors.checked(sensor)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        pose = values.atPose3(key)
        R = np.tile(pose.rotation().matrix(), (n, 1, 1))
        p = np.tile(pose.translation(), (n, 1))
        residuals = key_pose_residuals(readings, field_map, R, p, known)
        if jacobians is not None:
            jacobians[0] = residuals.de_dX.reshape(3 * n, 6)
        return residuals.reading.residual.ravel()

    return gtsam.CustomFactor(noise_of(noise, 3 * n), [key], error)

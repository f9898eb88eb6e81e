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

from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.field_map import DifferentiableMap, FloatArray, Jacobians
from l2m_factors.joint_residual import Residual
from l2m_factors.key_pose_batch import KeyPoseBatch, are_same
from l2m_factors.key_pose_readings import (
    Calibrations,
    KeyPoseReadings,
    KeyPoseResiduals,
    key_pose_residuals,
)
from l2m_factors.keys import M, X
from l2m_factors.motion import skew
from l2m_factors.slow_error import SlowError
from l2m_factors.step import Slots, StepError
from l2m_factors.whitening import Whitening


class TileField(Protocol):
    """A field that is linear in m weights."""

    def features(self, points: FloatArray, /) -> FloatArray:
        """Return the field of each weight at points (N, 3) in metres, uT, shape (N, 3, m)."""

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray, /
    ) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m, of weights of shape (m,)."""


class WeightedField:
    """A tile's field with weights that are given: a ``DifferentiableMap`` in the anchor's frame."""

    def __init__(self, tile: TileField, weights: FloatArray) -> None:
        self._tile, self._weights = tile, weights

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        return self._tile.field_and_gradient(points, self._weights)


@dataclass(frozen=True)
class TilePlaces:
    """Where n readings are in the frame of a tile's anchor.

    Attributes
    ----------
    R_anchor_key
        Rotation of each one's key pose, shape (n, 3, 3).
    R_key_lidar, t_key
        The lidar's rotation at each reading, (n, 3, 3), and the sensor's place in metres, (n, 3),
        both from the key pose.
    x
        Places in the anchor's frame in metres, shape (n, 3).
    """

    R_anchor_key: FloatArray
    R_key_lidar: FloatArray
    t_key: FloatArray
    x: FloatArray

    @property
    def by_key(self) -> FloatArray:
        """Derivatives of places by a right perturbation of each one's key pose, (n, 3, 6)."""
        # R exp(w) t = R t - R [t]_x w; a right shift goes along the axes of the key pose.
        R = self.R_anchor_key
        return np.concatenate([-R @ skew(self.t_key), R], axis=2)

    @property
    def R_anchor_lidar(self) -> FloatArray:
        """The lidar's rotation, and derivatives of places by each sensor's position, (n, 3, 3)."""
        return np.asarray(self.R_anchor_key @ self.R_key_lidar)

    def __getitem__(self, rows: npt.NDArray[np.int64]) -> "TilePlaces":
        return TilePlaces(
            self.R_anchor_key[rows], self.R_key_lidar[rows], self.t_key[rows], self.x[rows]
        )


class TileBatch(KeyPoseBatch):
    """Readings on key poses in one tile, for one thread at a time.

    Parameters
    ----------
    number
        b, of the tile.
    anchor
        a, the key pose that the tile is fixed to.
    field
        What the weights mean.
    readings, fixed
        As of ``KeyPoseBatch``.
    """

    def __init__(
        self,
        number: int,
        anchor: int,
        field: TileField,
        readings: KeyPoseReadings,
        fixed: Calibrations | None = None,
    ) -> None:
        super().__init__(readings, fixed)
        self._number, self._anchor, self._tile = number, anchor, field
        self._point: tuple[FloatArray, FloatArray, Calibrations]  # of the last evaluation
        self._by_weights: dict[int, FloatArray] = {}  # what no factor has taken yet
        self._places: TilePlaces | None = None  # where they were asked for last
        self._placed = gtsam.Values()  # what they depend on

    def keys_of(self, key_pose: int) -> list[int]:
        """Return the keys that the readings on a key pose depend on.

        At the anchor the readings know nothing of its pose.
        """
        poses = [] if key_pose == self._anchor else [X(key_pose), X(self._anchor)]
        return [*poses, M(self._number), *self._variables.keys(self._sensors[key_pose])]

    def jacobians(
        self, residuals: KeyPoseResiduals, values: gtsam.Values, key_pose: int
    ) -> list[FloatArray]:
        """Return derivatives by each of ``keys_of`` of n readings, each of shape (n, 3, .)."""
        rows, relative = self._rows[key_pose], self._pose(values, key_pose)
        by_sensors = self._variables.jacobians(residuals.reading, rows)
        blocks = [self._taken_by_weights(key_pose), *by_sensors]
        if key_pose == self._anchor:
            return blocks
        by_key = residuals.de_dX[rows]
        # With A the anchor, (A exp(a))^-1 X = A^-1 X exp(-Ad(X^-1 A) a): Sola, Deray, Atchuthan, "A
        # micro Lie theory for state estimation in robotics", 2018, on the adjoint.
        return [by_key, -by_key @ relative.inverse().AdjointMap(), *blocks]

    def places(self, values: gtsam.Values, key_pose: int) -> TilePlaces:
        """Return where the readings on a key pose are, without a query of the field."""
        keys, last = self._keys_asked(key_pose), self._last
        if self._places is None or not are_same(values, self._placed, keys):
            if last is not None and are_same(values, last.at, keys):
                point, self._placed = self._point, last.at
            else:
                point = self._evaluation_point(values)
                self._placed = self._extracted(values)
            self._places = self._places_at(*point)
        return self._places[self._rows[key_pose]]

    def place_keys_of(self, key_pose: int) -> list[int]:
        """Return the keys that ``places`` depend on, but for time offsets."""
        poses = [] if key_pose == self._anchor else [X(key_pose), X(self._anchor)]
        return [*poses, *self._variables.place_keys(self._sensors[key_pose])]

    def place_jacobians(
        self, values: gtsam.Values, key_pose: int, where: TilePlaces
    ) -> list[FloatArray]:
        """Return derivatives of n places by each of ``place_keys_of``, each of shape (n, 3, .)."""
        blocks = self._variables.place_jacobians(where.R_anchor_lidar, self._rows[key_pose])
        if key_pose == self._anchor:
            return blocks
        by_key = where.by_key
        relative = self._pose(values, key_pose)
        return [by_key, -by_key @ relative.inverse().AdjointMap(), *blocks]

    def _evaluated(self, values: gtsam.Values) -> KeyPoseResiduals:
        self._point = R, p, sensors = self._evaluation_point(values)
        self._by_weights = {}
        return key_pose_residuals(self._readings, self._field(values), R, p, sensors)

    def _taken_by_weights(self, key_pose: int) -> FloatArray:
        """Return derivatives by the weights of n readings, shape (n, 3, m).

        All of the batch are evaluated at once, and each is let go when its factor has taken it: a
        drive's together are as large as its linear system.
        """
        if key_pose not in self._by_weights:
            every = self._derivatives_by_weights(np.arange(len(self)))
            self._by_weights = {k: every[rows] for k, rows in self._rows.items()}
        return self._by_weights.pop(key_pose)

    def _derivatives_by_weights(self, rows: npt.NDArray[np.int64]) -> FloatArray:
        """Return derivatives by the weights where n residuals were evaluated, (n, 3, m)."""
        where, known = self._evaluated_places()[rows], self._point[2]
        C = known.distortion[self._readings.sensor[rows], :9].reshape(-1, 3, 3)
        turned = C @ where.R_anchor_lidar.transpose(0, 2, 1)
        return np.asarray(turned @ self._tile.features(where.x))

    def _evaluated_places(self) -> TilePlaces:
        """Return where all N readings are where residuals were evaluated last."""
        return self._places_at(*self._point)

    def _places_at(self, R: FloatArray, p: FloatArray, known: Calibrations) -> TilePlaces:
        """Return where all N readings are, from the key pose of each and the sensors."""
        R_key_lidar, p_key_lidar = self._readings.lidar_at(known.offset)
        t_key = np.einsum("nij,nj->ni", R_key_lidar, known.t[self._readings.sensor]) + p_key_lidar
        return TilePlaces(R, R_key_lidar, t_key, np.einsum("nij,nj->ni", R, t_key) + p)

    def _pose(self, values: gtsam.Values, key_pose: int) -> gtsam.Pose3:
        if key_pose == self._anchor:
            return gtsam.Pose3()
        return values.atPose3(X(self._anchor)).between(values.atPose3(X(key_pose)))

    def _is_present(self, values: gtsam.Values, key_pose: int) -> bool:
        if key_pose == self._anchor:
            return True
        return bool(values.exists(X(self._anchor)) and values.exists(X(key_pose)))

    def _field(self, values: gtsam.Values) -> DifferentiableMap:
        return WeightedField(self._tile, values.atVector(M(self._number)))

    def _own_keys(self, key_poses: list[int]) -> list[int]:
        moving = [X(k) for k in key_poses if k != self._anchor]
        return [M(self._number), *moving, *([X(self._anchor)] if moving else [])]


def tile_factor(
    batch: TileBatch,
    key_pose: int,
    whitening: Whitening,
    step: StepError | None = None,
    slow: SlowError | None = None,
) -> gtsam.CustomFactor:
    """Return one factor for the readings of all sensors on a key pose in an unknown field.

    It is on ``X(k)``, the anchor ``X(a)``, the weights ``M(b)``, on the calibrations unless the
    batch has them fixed, and, if its readings are known to lie between two key poses, on
    ``X(k+1)``; with a slow error on ``N(k)`` and ``N(k+1)``. Parameters as of ``tile_residual``.
    """
    return tile_residual(batch, key_pose, whitening, step, slow).factor()


def tile_residual(
    batch: TileBatch,
    key_pose: int,
    whitening: Whitening,
    step: StepError | None = None,
    slow: SlowError | None = None,
) -> Residual:
    """Return the residual of that factor.

    Parameters
    ----------
    batch
        The readings that are evaluated together.
    key_pose
        Number k of the key pose.
    whitening
        Of its n readings.
    step
        What the error of the step to the next key pose adds to them; nothing without.
    slow
        What they have of a slow error of their sensor; nothing without.

    Raises
    ------
    ValueError
        There are no readings on the key pose, or an array is of another number of readings.
    """
    rows = batch.rows_of(key_pose)
    whitening = whitening.checked(len(rows))
    terms = [each.checked(len(rows)) for each in (step, slow) if each is not None]
    slots = Slots([*batch.keys_of(key_pose), *(key for each in terms for key in each.keys)])

    def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        residuals = batch.residuals(values, key_pose)
        e = residuals.reading.residual[rows]
        for each in terms:
            e = e + each.residual(values)
        if jacobians is not None:
            blocks = batch.jacobians(residuals, values, key_pose)
            blocks += [block for each in terms for block in each.jacobians(values)]
            slots.fill(jacobians, whitening, blocks)
        return whitening(e[:, :, None]).ravel()

    return Residual(slots.keys, 3 * len(rows), error)

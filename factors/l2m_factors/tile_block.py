"""Readings of a tile on several key poses as one factor, evaluated and made white all at once.

A graph of many readings spends its time in Python: with ``tile_factor`` each key pose asks for its
values to see whether they changed, and puts together as many blocks of derivatives. Here a factor
asks once for several key poses, and takes its rows from what was made for all of the tile.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import numpy.typing as npt

from l2m_factors.arguments import numbers
from l2m_factors.block_errors import BlockErrors, ReadingErrors
from l2m_factors.complexity import ComplexityPenalty
from l2m_factors.field_map import FloatArray, Jacobians
from l2m_factors.joint_residual import Residual
from l2m_factors.key_pose_readings import Calibrations, KeyPoseReadings, KeyPoseResiduals
from l2m_factors.keys import M, X
from l2m_factors.motion import skew
from l2m_factors.tile import TileBatch, TileField, TilePlaces

# Sensors in one factor where their calibrations are variables: GTSAM multiplies each variable's
# block with each other's, though a reading depends on one sensor. A drive with 12 sensors took 20.3
# s of a processor with all in one factor, 19.4 with 6, 17.5 with 4, 22.2 with 2, 25.6 with 1.
SENSORS = 4


@dataclass(frozen=True)
class TileDerivatives:
    """Derivatives of q components of each of n readings.

    Attributes
    ----------
    by_key, by_anchor
        By the key pose of each and by the tile's anchor, shape (n, q, 6).
    by_weights
        By the tile's weights, shape (n, q, m); absent of what does not depend on them.
    by_sensor
        By the variables of each one's sensor, one after the other, shape (n, q, .) each.
    """

    by_key: FloatArray
    by_anchor: FloatArray
    by_weights: FloatArray | None
    by_sensor: tuple[FloatArray, ...]

    def __getitem__(self, rows: npt.NDArray[np.int64]) -> "TileDerivatives":
        by_weights = None if self.by_weights is None else self.by_weights[rows]
        by_sensor = tuple(each[rows] for each in self.by_sensor)
        return TileDerivatives(self.by_key[rows], self.by_anchor[rows], by_weights, by_sensor)

    def along(self, slope: FloatArray) -> "TileDerivatives":
        """Return those of one component, the sum of three times a slope, shape (n, 3)."""
        by_sensor = tuple(slope[:, None] @ each for each in self.by_sensor)
        by_key, by_anchor = slope[:, None] @ self.by_key, slope[:, None] @ self.by_anchor
        return TileDerivatives(by_key, by_anchor, None, by_sensor)


@dataclass(frozen=True)
class BlockRows:
    """The readings of a factor, and on which variables each of them depends.

    Attributes
    ----------
    keys
        Key poses but the anchor, the anchor if there are any, weights if they are, sensors.
    rows
        The n readings among those of the tile, shape (n,).
    of_key_pose
        Which of the n are on each of the key poses but the anchor: one run each.
    of_sensor
        Which of the n are of each sensor that is a variable.
    """

    keys: list[int]
    rows: npt.NDArray[np.int64]
    of_key_pose: tuple[slice, ...]
    of_sensor: tuple[npt.NDArray[np.int64], ...]

    def derivatives(self, own: TileDerivatives) -> list[FloatArray]:
        """Return derivatives of the n readings by each of ``keys``, shape (n, q, .) each."""
        blocks = [placed(own.by_key, at) for at in self.of_key_pose]
        blocks += [own.by_anchor] if self.of_key_pose else []
        blocks += [] if own.by_weights is None else [own.by_weights]
        blocks += [placed(each, at) for at in self.of_sensor for each in own.by_sensor]
        return blocks

    def fill(self, jacobians: list[FloatArray], own: TileDerivatives) -> None:
        """Put in derivatives of the n readings by each of ``keys``, shape (q n, .) each."""
        for slot, block in enumerate(self.derivatives(own)):
            jacobians[slot] = block.reshape(-1, block.shape[2])


def placed(derivatives: FloatArray, at: slice | npt.NDArray[np.int64]) -> FloatArray:
    """Return derivatives where ``at`` some readings depend on a variable, zero elsewhere."""
    block = np.zeros(derivatives.shape)
    block[at] = derivatives[at]
    return block


def run_of(numbers: npt.NDArray[np.int64], number: int) -> slice:
    """Return where one of several numbers stands, which come in runs."""
    at = np.flatnonzero(numbers == number)
    return slice(int(at[0]), int(at[-1]) + 1)


class TileBlocks(TileBatch):
    """Readings on key poses in one tile, each with noise of its own, for one thread at a time.

    Parameters
    ----------
    number, anchor, field, readings, fixed
        As of ``TileBatch``.
    whitening
        Of each of N readings, 1/uT, shape (N, 3, 3).

    Raises
    ------
    ValueError
        As of ``TileBatch``, or the whitening is of another number of readings.
    """

    def __init__(
        self,
        number: int,
        anchor: int,
        field: TileField,
        readings: KeyPoseReadings,
        whitening: FloatArray,
        fixed: Calibrations | None = None,
    ) -> None:
        super().__init__(number, anchor, field, readings, fixed)
        self._W = numbers("whitening", whitening, (len(readings), 3, 3))
        self._on_anchor = self._rows.get(anchor, np.empty(0, dtype=np.int64))
        self._white: FloatArray
        self._where: TilePlaces
        self._of_readings: TileDerivatives | None = None
        self._of_places: TileDerivatives | None = None

    def white_residuals(self, key_poses: Sequence[int]) -> Iterator[Residual]:
        """Yield the white residuals of the readings on some key poses, of a few sensors each."""
        sensors = self._sensors_on(key_poses)
        few = SENSORS if self._variables.keys(sensors) else len(sensors)
        for first in range(0, len(sensors), few):
            yield self._residual(key_poses, sensors[first : first + few])

    def residual_with_errors(
        self, key_poses: Sequence[int], errors: Sequence[ReadingErrors]
    ) -> Residual:
        """Return the white residual of the readings on some key poses, which share errors.

        It is that of ``tile_residual`` for each, one after the other.

        Parameters
        ----------
        key_poses
            Their numbers.
        errors
            Of the readings on each of them.

        Raises
        ------
        ValueError
            There are no readings on a key pose, or an array is of another number of readings.
        """
        counts = [len(self.rows_of(k)) for k in key_poses]
        sensors = self._sensors_on(key_poses)
        own_keys = [M(self._number), *self._variables.keys(sensors)]
        block = self._block(key_poses, own_keys, sensors)
        ends = np.cumsum(counts).tolist()
        runs = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        shared = BlockErrors(runs, errors, self._W[block.rows])
        keys = list(dict.fromkeys([*block.keys, *shared.keys]))

        def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
            found = self._evaluation(values, block.keys).residuals
            e = (self._white[block.rows] + shared.residual(values))[:, :, None]
            shared.project(e)
            if jacobians is not None:
                own = block.derivatives(self._reading_derivatives(found, block.rows))
                by_key = shared.added(dict(zip(block.keys, own, strict=True)), values)
                # Side by side, so that all are freed of the common errors at once.
                whole = np.concatenate([by_key[key] for key in keys], axis=2)
                shared.project(whole)
                edges = np.cumsum([by_key[key].shape[2] for key in keys[:-1]])
                parts = np.split(whole.reshape(e.size, -1), edges, axis=1)
                for slot, part in enumerate(parts):
                    jacobians[slot] = part
            return e.ravel()

        return Residual(keys, 3 * len(block.rows), error)

    def penalty(self, key_poses: Sequence[int], every: ComplexityPenalty) -> Residual | None:
        """Return the penalty of readings on some key poses, (n,); None where it has no variables.

        Parameters
        ----------
        key_poses
            Their numbers.
        every
            Of all N readings of the tile.
        """
        sensors = self._sensors_on(key_poses)
        block = self._block(key_poses, self._variables.place_keys(sensors), sensors)
        if not block.keys:
            return None
        own = every[block.rows]
        # Places depend on time offsets, too, though a penalty has no derivative by them.
        asked = list(dict.fromkeys(key for k in key_poses for key in self._keys_asked(k)))

        def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
            self._evaluation(values, asked)
            if jacobians is not None:
                block.fill(jacobians, self._place_derivatives()[block.rows].along(own.slope))
            away = self._where.x[block.rows] - own.at
            return np.asarray(own.value + np.einsum("ni,ni->n", own.slope, away))

        return Residual(block.keys, len(block.rows), error)

    def _sensors_on(self, key_poses: Sequence[int]) -> list[int]:
        return sorted({sensor for k in key_poses for sensor in self._sensors[k]})

    def _residual(self, key_poses: Sequence[int], sensors: list[int]) -> Residual:
        keys = [M(self._number), *self._variables.keys(sensors)]
        block = self._block(key_poses, keys, sensors)

        def error(values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
            found = self._evaluation(values, block.keys).residuals
            if jacobians is not None:
                block.fill(jacobians, self._reading_derivatives(found, block.rows))
            return self._white[block.rows].ravel()

        return Residual(block.keys, 3 * len(block.rows), error)

    def _block(
        self, key_poses: Sequence[int], beside_poses: list[int], sensors: list[int]
    ) -> BlockRows:
        rows = np.concatenate([self._rows[k] for k in key_poses])
        rows = rows[np.isin(self._readings.sensor[rows], sensors)]
        number, sensor = self._readings.key_pose[rows], self._readings.sensor[rows]
        runs = {k: run_of(number, k) for k in key_poses if k != self._anchor and k in number}
        moving = list(runs)
        poses = [X(k) for k in (*moving, self._anchor)] if moving else []
        free = sensors if self._variables.keys(sensors) else []
        return BlockRows(
            [*poses, *beside_poses],
            rows,
            tuple(runs.values()),
            tuple(np.flatnonzero(sensor == each) for each in free),
        )

    def _evaluated(self, values: gtsam.Values) -> KeyPoseResiduals:
        found = super()._evaluated(values)
        self._where = self._places_at(*self._point)
        self._white = np.einsum("nij,nj->ni", self._W, found.reading.residual)
        self._of_readings = self._of_places = None
        return found

    def _reading_derivatives(
        self, found: KeyPoseResiduals, rows: npt.NDArray[np.int64]
    ) -> TileDerivatives:
        """Return derivatives of white residuals, those of all readings, at some rows.

        Those by the weights are made for these rows alone: of a whole drive they are as large as
        its linear system.
        """
        if self._of_readings is None:
            reading, by_key = found.reading, self._W @ found.de_dX
            by_sensor = [reading.de_dt, reading.de_dD]
            by_sensor += [reading.de_dS] if self._variables.timed else []
            by_sensor_white = tuple(self._W @ each for each in by_sensor)
            self._of_readings = TileDerivatives(
                by_key, self._by_anchor(by_key), None, by_sensor_white
            )
        own = self._of_readings[rows]
        return replace(own, by_weights=self._W[rows] @ self._derivatives_by_weights(rows))

    def _place_derivatives(self) -> TileDerivatives:
        """Return derivatives of places in the anchor's frame, without time offsets."""
        if self._of_places is None:
            by_key, by_sensor = self._where.by_key, (self._where.R_anchor_lidar,)
            self._of_places = TileDerivatives(by_key, self._by_anchor(by_key), None, by_sensor)
        return self._of_places

    def _evaluated_places(self) -> TilePlaces:
        return self._where

    def _by_anchor(self, by_key: FloatArray) -> FloatArray:
        """Return derivatives by the anchor's pose from those by each key pose, (N, q, 6)."""
        # -Ad(T^-1) with T = (R, p), the key pose in the anchor's frame: ``TileBatch.jacobians``.
        R, p, _ = self._point
        turned, shifted = by_key[:, :, :3], by_key[:, :, 3:] @ R.transpose(0, 2, 1)
        by_anchor = np.concatenate(
            [shifted @ skew(p) - turned @ R.transpose(0, 2, 1), -shifted], axis=2
        )
        by_anchor[self._on_anchor] = 0.0
        return by_anchor

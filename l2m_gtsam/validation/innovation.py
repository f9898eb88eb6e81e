"""Readings of one sensor beside what a map and a known calibration predict, made white together.

Errors of the map, shared by readings near each other, errors of the poses, shared by readings
near each other in time, and fields of recorded numbers are weights with a prior, as in the solve;
QR takes them out. What remains of the readings is white.
"""

from dataclasses import dataclass

import numpy as np

from l2m_factors import M, P
from l2m_factors.shared_errors import whitened
from l2m_gtsam.calibration.coverage import Coverage, NothingShared, UncertainMap, cover
from l2m_gtsam.calibration.factor_graph import Estimate, batch_readings
from l2m_gtsam.calibration.group_noise import group_noise
from l2m_gtsam.calibration.view import QueryableMap, observe
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.validation.alterations import PARAMETERS, Told, reduced

ROWS = 4000  # that are reduced at once


@dataclass(frozen=True)
class KnownCalibration:
    """A sensor as a calibration has it.

    Attributes
    ----------
    vector
        t in metres, C row by row, H in uT, time offset in seconds, shape (16,).
    noise
        Standard deviation of its noise in uT.
    number_sigma
        Standard deviations of the fields of K recorded numbers that were taken off the readings,
        in uT per unit, shape (K, 3).
    """

    vector: FloatArray
    noise: float
    number_sigma: FloatArray

    def estimate(self) -> Estimate:
        """Return it as an estimate of a single sensor."""
        return Estimate(
            t=self.vector[None, :3],
            distortion=self.vector[None, 3:15],
            noise=np.array([self.noise]),
            ridge=np.zeros(1),
            offset=self.vector[15:],
        )


def knows_its_errors(field_map: QueryableMap) -> bool:
    """Return whether a map tells how its errors are correlated."""
    return isinstance(field_map, UncertainMap)


def told_by(
    readings: Readings, field_map: QueryableMap, known: KnownCalibration, correlation_s: float
) -> Told:
    """Return what readings tell of a sensor's parameters about those that are known.

    Parameters
    ----------
    readings
        Of one sensor, all inside the map, with their poses at the known time offset; what follows
        recorded numbers is taken off.
    field_map
        The map.
    known
        The calibration, whose own errors do not count here.
    correlation_s
        How long an error of a pose lasts, seconds.

    Returns
    -------
    Told
        Of a change of (t, C row by row, H, time offset).
    """
    estimate = known.estimate()
    view = observe(readings, field_map, estimate, 1)
    errors = field_map if isinstance(field_map, UncertainMap) else NothingShared()
    coverage = cover(view, errors, estimate, correlation_s)
    noise = group_noise(view, field_map, coverage, estimate)
    J, e = _linearised(view.readings, field_map, estimate)
    by_number = _number_errors(view.readings, known.number_sigma)
    C, at = estimate.C()[0], coverage.columns
    shared = sum(coverage.sizes.values())
    numbers = slice(shared, shared + by_number.shape[2])
    width = numbers.stop + PARAMETERS + 1
    collected = _Collected(width, priors_of(coverage, width, numbers))
    for group, own, W in zip(coverage.groups, noise.errors, noise.whitenings, strict=True):
        rows = np.zeros((3 * len(group.rows), width))
        for each in own:
            rows[:, at[each.key]] += whitened(W, C @ each.features)
        rows[:, numbers] = whitened(W, by_number[group.rows])
        rows[:, numbers.stop : -1] = whitened(W, J[group.rows])
        rows[:, -1:] = whitened(W, e[group.rows, :, None])
        collected.add(rows)
    return Told.of(collected.root()[numbers.stop :, numbers.stop :])


class _Collected:
    """Rows of a least-squares problem, reduced as they come: memory stays bounded."""

    def __init__(self, width: int, first: FloatArray) -> None:
        self._width, self._parts, self._count = width, [first], len(first)

    def add(self, rows: FloatArray) -> None:
        self._parts.append(rows)
        self._count += len(rows)
        if self._count > max(ROWS, 3 * self._width):
            self._parts = [self.root()]
            self._count = self._width

    def root(self) -> FloatArray:
        return reduced(np.concatenate(self._parts))


def priors_of(coverage: Coverage, width: int, numbers: slice) -> FloatArray:
    """Return white rows of what is known of the weights, shape (K, width)."""
    at = coverage.columns
    tiles = np.concatenate([np.arange(at[M(t)].start, at[M(t)].stop) for t in coverage.tiles])
    rows = np.zeros((numbers.stop, width))
    rows[: len(tiles), tiles] = coverage.root_information
    rows[numbers, numbers] = np.eye(numbers.stop - numbers.start)
    if coverage.knots is not None:
        # each knot is like the one before it in part
        first = at[P(0)]
        size = first.stop - first.start
        rows[first, first] = np.eye(size)
        for knot, like in enumerate(coverage.knots.correlation, start=1):
            own = 1 / np.sqrt(1 - like**2)
            before, this = at[P(knot - 1)], at[P(knot)]
            rows[this, this], rows[this, before] = own * np.eye(size), -like * own * np.eye(size)
    return rows


def _linearised(
    readings: Readings, field_map: QueryableMap, estimate: Estimate
) -> tuple[FloatArray, FloatArray]:
    """Return derivatives of predicted readings, (N, 3, 16), and innovations in uT, (N, 3)."""
    batch = batch_readings(readings, field_map)
    found = batch.residuals(estimate.values([0]), 0)
    return np.concatenate(batch.jacobians(found), axis=2), -found.residual


def _number_errors(readings: Readings, sigma: FloatArray) -> FloatArray:
    """Return what a sigma of each number's field does to readings in uT, shape (N, 3, 3 K)."""
    if readings.regressors is None or not sigma.size:
        return np.zeros((len(readings), 3, 0))
    features = np.einsum("nk,ki,ij->nikj", readings.regressors, sigma, np.eye(3))
    return np.asarray(features.reshape(len(readings), 3, -1))

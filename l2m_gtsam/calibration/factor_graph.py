"""The calibration as a factor graph: readings in, ``T(i)`` and ``D(i)`` out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import gtsam
import numpy as np

from l2m_factors import (
    BatchedReadings,
    D,
    DifferentiableMap,
    MagneticReadings,
    PoseMotion,
    S,
    T,
    block_factor,
    distortion_prior,
    held_directions,
    reading_factor,
)
from l2m_gtsam.calibration.priors import HOLD_S, NO_PRIORS, Priors
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.noise import whitening
from l2m_gtsam.solve.rank import Determinacy


class FactorForm(StrEnum):
    """How readings become factors."""

    BLOCK = "block"
    READING = "reading"


@dataclass(frozen=True)
class Estimate:
    """Current values of S sensors.

    Attributes
    ----------
    t
        Positions in the lidar frame in metres, shape (S, 3).
    distortion
        C row by row and H in uT, shape (S, 12).
    noise
        Standard deviations of the sensors' noise in uT, shape (S,).
    ridge
        Strength of each sensor's ridge: the information that it adds to each entry of C,
        shape (S,).
    offset
        Time offsets in seconds, shape (S,): a reading's pose is that at stamp + offset.
    priors
        What is known of the sensors beforehand.
    """

    t: FloatArray
    distortion: FloatArray
    noise: FloatArray
    ridge: FloatArray
    offset: FloatArray
    priors: Priors = NO_PRIORS

    def C(self) -> FloatArray:
        """Return the distortion matrices, shape (S, 3, 3)."""
        return np.asarray(self.distortion[:, :9].reshape(-1, 3, 3))

    def vector(self, sensor: int) -> FloatArray:
        """Return (t, C row by row, H) of one sensor, shape (15,)."""
        return np.concatenate([self.t[sensor], self.distortion[sensor]])

    def positions(self, sensors: list[int]) -> gtsam.Values:
        """Return T(i) of these sensors."""
        values = gtsam.Values()
        for sensor in sensors:
            values.insert(T(sensor), self.t[sensor])
        return values

    def values(self, sensors: list[int]) -> gtsam.Values:
        """Return T(i), D(i) and S(i) of these sensors."""
        values = self.positions(sensors)
        for sensor in sensors:
            values.insert(D(sensor), self.distortion[sensor])
            values.insert(S(sensor), float(self.offset[sensor]))
        return values

    def same_noise(self, other: "Estimate", sensor: int) -> bool:
        """Return whether a sensor's noise does not differ by more than 0.1 %."""
        return bool(abs(np.log(self.noise[sensor] / other.noise[sensor])) < 1e-3)

    def as_in(self, other: "Estimate", sensors: Sequence[int]) -> "Estimate":
        """Return the estimate with t, C and H of some sensors as another has them."""
        t, distortion = self.t.copy(), self.distortion.copy()
        at = list(sensors)
        t[at], distortion[at] = other.t[at], other.distortion[at]
        return replace(self, t=t, distortion=distortion)

    def updated(self, values: gtsam.Values, sensors: list[int]) -> "Estimate":
        """Return the estimate with these sensors' T(i), and the rest where present, taken over."""
        t, distortion, offset = self.t.copy(), self.distortion.copy(), self.offset.copy()
        for sensor in sensors:
            t[sensor] = values.atPoint3(T(sensor))
            if values.exists(D(sensor)):
                distortion[sensor] = values.atVector(D(sensor))
            if values.exists(S(sensor)):
                offset[sensor] = values.atDouble(S(sensor))
        return replace(self, t=t, distortion=distortion, offset=offset)


def batch_readings(
    readings: Readings, field_map: DifferentiableMap, distortion: FloatArray | None = None
) -> BatchedReadings:
    """Return the readings as one batch for the factors: on T(i), D(i) and S(i).

    With ``distortion``, shape (S, 12), they are on T(i) alone, and poses stay as they are.
    """
    motion = None
    if distortion is None:
        at_rest = np.zeros((len(readings), 6)), np.zeros(len(readings))
        known = readings.motion
        motion = PoseMotion(*(at_rest if known is None else (known.twist_lidar, known.offset)))
    magnetic = MagneticReadings(
        readings.sensor, readings.R_map_lidar, readings.p_map_lidar, readings.field, motion
    )
    return BatchedReadings(field_map, magnetic, distortion)


def reading_graph(
    batch: BatchedReadings, covariance: FloatArray, form: FactorForm
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of all readings.

    Parameters
    ----------
    batch
        N readings.
    covariance
        Covariance of each reading's residual in uT^2, shape (N, 3, 3).
    form
        One factor per sensor or one per reading; the mathematics is the same.
    """
    graph = gtsam.NonlinearFactorGraph()
    if form is FactorForm.BLOCK:
        W = whitening(covariance)
        for sensor in batch.sensors:
            graph.add(block_factor(batch, sensor, W))
    else:
        for n in range(len(batch)):
            noise = gtsam.noiseModel.Gaussian.Covariance(covariance[n])
            graph.add(reading_factor(batch, n, noise))
    return graph


def prior_graph(estimate: Estimate, tests: Mapping[int, Determinacy]) -> gtsam.NonlinearFactorGraph:
    """Return what is known beforehand, the ridge, and a hold on what cannot be determined.

    The ridge is towards an ideal sensor; a nominal rotation takes its place.

    Parameters
    ----------
    estimate
        What is known, strength of the ridge, and where directions are held; a time offset is held
        at zero.
    tests
        Rank test of each sensor of the graph, which says what is held.
    """
    graph, mounts = estimate.priors.graph(tests), estimate.priors.mounts()
    tight = gtsam.noiseModel.Isotropic.Sigma(1, HOLD_S)
    for sensor, test in tests.items():
        if estimate.ridge[sensor] > 0 and sensor not in mounts:
            sigma = float(estimate.ridge[sensor] ** -0.5)
            graph.add(distortion_prior(sensor, np.eye(3), sigma))
        if len(test.held):
            graph.add(held_directions(sensor, test.held, estimate.vector(sensor)))
        if not test.offset:
            graph.add(gtsam.PriorFactorDouble(S(sensor), 0.0, tight))
    return graph


def unit_priors(sizes: Mapping[int, int]) -> gtsam.NonlinearFactorGraph:
    """Return the priors of weights of zero mean and unit variance, by key and number."""
    graph = gtsam.NonlinearFactorGraph()
    for key, size in sizes.items():
        unit = gtsam.noiseModel.Unit.Create(size)
        graph.add(gtsam.PriorFactorVector(key, np.zeros(size), unit))
    return graph


def whitened_jacobian(
    batch: BatchedReadings, W: FloatArray, values: gtsam.Values, sensor: int
) -> FloatArray:
    """Return derivatives of a sensor's white residuals by (t, C by row, H, offset), (3 n, 16)."""
    rows = batch.rows_of(sensor)
    parts = batch.white_jacobians(batch.residuals(values, sensor), rows, W[rows])
    return np.concatenate(parts, axis=1)

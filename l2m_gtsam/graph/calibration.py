"""The calibration as a factor graph: readings in, ``T(i)`` and ``D(i)`` out."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import gtsam
import numpy as np

from l2m_factors import (
    BatchedReadings,
    D,
    FieldMap,
    MagneticReadings,
    T,
    block_factor,
    distortion_prior,
    held_directions,
    reading_factor,
)
from l2m_gtsam.data import FloatArray, Readings
from l2m_gtsam.solve.noise import whitening


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
    """

    t: FloatArray
    distortion: FloatArray
    noise: FloatArray
    ridge: FloatArray

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
        """Return T(i) and D(i) of these sensors."""
        values = self.positions(sensors)
        for sensor in sensors:
            values.insert(D(sensor), self.distortion[sensor])
        return values

    def updated(self, values: gtsam.Values, sensors: list[int]) -> "Estimate":
        """Return the estimate with these sensors' T(i), and D(i) where present, taken over."""
        t, distortion = self.t.copy(), self.distortion.copy()
        for sensor in sensors:
            t[sensor] = values.atPoint3(T(sensor))
            if values.exists(D(sensor)):
                distortion[sensor] = values.atVector(D(sensor))
        return replace(self, t=t, distortion=distortion)


def batch_readings(
    readings: Readings, field_map: FieldMap, distortion: FloatArray | None = None
) -> BatchedReadings:
    """Return the readings as one batch for the factors; ``distortion`` (S, 12) holds D fixed."""
    magnetic = MagneticReadings(
        readings.sensor, readings.R_map_lidar, readings.p_map_lidar, readings.field
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


def prior_graph(estimate: Estimate, held: Mapping[int, FloatArray]) -> gtsam.NonlinearFactorGraph:
    """Return the ridge towards an ideal sensor and the directions that are held.

    Parameters
    ----------
    estimate
        Strength of the ridge, and where directions are held.
    held
        For each sensor of the graph the directions of its 15 parameters that stay, shape (K, 15).
    """
    graph = gtsam.NonlinearFactorGraph()
    for sensor, directions in held.items():
        if estimate.ridge[sensor] > 0:
            sigma = float(estimate.ridge[sensor] ** -0.5)
            graph.add(distortion_prior(sensor, np.eye(3), sigma))
        if len(directions):
            graph.add(held_directions(sensor, directions, estimate.vector(sensor)))
    return graph


def whitened_jacobian(
    batch: BatchedReadings, W: FloatArray, values: gtsam.Values, sensor: int
) -> FloatArray:
    """Return the derivatives of a sensor's white residuals by (t, C row by row, H), (3 n, 15)."""
    jacobian, _ = block_factor(batch, sensor, W).linearize(values).jacobian()
    return np.asarray(jacobian)


def sensor_covariance(marginals: gtsam.Marginals, sensor: int) -> FloatArray:
    """Return the covariance of (t, C row by row, H) of one sensor, shape (15, 15)."""
    joint = marginals.jointMarginalCovariance([T(sensor), D(sensor)])
    keys = (T(sensor), D(sensor))
    return np.asarray(np.block([[joint.at(a, b) for b in keys] for a in keys]))

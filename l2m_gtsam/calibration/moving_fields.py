"""Fields that move with recorded numbers: variables ``Q(i)`` of the sensors that they act on.

A number q_k, a motor's current, adds q_k g_k to the field at a sensor, in the lidar frame; the
sensor reads h_k = C g_k of it. That is an error of the map which all readings of a sensor share.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from l2m_factors import Q, SharedError
from l2m_gtsam.data import FloatArray, Readings

AXES = 3


@dataclass(frozen=True)
class Correction:
    """What a solve finds of the fields of K numbers at a sensor, beyond what was taken off before.

    Attributes
    ----------
    h
        In the sensor's frame in uT per unit of each number, shape (K, 3).
    sigma
        Standard deviations, shape (K, 3).
    """

    h: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class MovingFields:
    """The sensors whose field recorded numbers change.

    Attributes
    ----------
    scales
        Of each such sensor, the field of a unit of each number that is one standard deviation of
        its prior in uT, shape (K,).
    """

    scales: Mapping[int, FloatArray] = field(default_factory=dict)

    @property
    def sizes(self) -> dict[int, int]:
        """Number of weights of each key of the graph."""
        return {Q(sensor): AXES * len(scale) for sensor, scale in self.scales.items()}

    def errors(self, sensor: int, numbers: FloatArray | None) -> tuple[SharedError, ...]:
        """Return what readings of a sensor at these numbers, shape (n, K), share."""
        if sensor not in self.scales or numbers is None:
            return ()
        scaled = numbers * self.scales[sensor]
        features = np.einsum("nk,ij->nikj", scaled, np.eye(AXES))
        return (SharedError(Q(sensor), features.reshape(len(scaled), AXES, -1)),)

    def prior(self) -> gtsam.NonlinearFactorGraph:
        """Return the prior of all weights: none, with unit variance."""
        graph = gtsam.NonlinearFactorGraph()
        for key, size in self.sizes.items():
            unit = gtsam.noiseModel.Unit.Create(size)
            graph.add(gtsam.PriorFactorVector(key, np.zeros(size), unit))
        return graph

    def correction(
        self, sensor: int, weights: FloatArray, covariance: FloatArray, C: FloatArray
    ) -> Correction:
        """Return what weights, shape (3 K,), of this covariance say of a sensor's readings.

        C counts as exact: the correction is small beside what it is added to.
        """
        scale = self.scales[sensor]
        J = np.kron(np.diag(scale), C)
        h = (J @ weights).reshape(-1, AXES)
        variance = np.einsum("ij,jk,ik->i", J, covariance, J)
        return Correction(h, np.sqrt(variance).reshape(-1, AXES))


def moving_fields(readings: Readings, prior_ut: float) -> MovingFields:
    """Return the sensors whose readings come with numbers that are not zero.

    Parameters
    ----------
    readings
        The readings used.
    prior_ut
        Standard deviation of the field that a number adds when it differs from its mean by one
        standard deviation of its own, uT.
    """
    if readings.regressors is None:
        return MovingFields()
    scales = {}
    for sensor in np.unique(readings.sensor).tolist():
        numbers = readings.regressors[readings.rows_of(sensor)]
        if numbers.any():
            spread = numbers.std(axis=0)
            scales[sensor] = np.where(spread > 0, prior_ut / np.where(spread > 0, spread, 1), 0.0)
    return MovingFields(scales)

"""Covariances of sensors from a linear graph: GTSAM's marginals, and QR where these are refused."""

from collections.abc import Callable

import gtsam
import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from l2m_factors import T
from l2m_gtsam.calibration.optimise import refused
from l2m_gtsam.calibration.sensor_columns import PLACES, columns_among, columns_of, keys_of
from l2m_gtsam.data import FloatArray

JointCovariance = Callable[[tuple[int, ...]], FloatArray]
"""Of all parameters of some sensors, in order, shape (16 n, 16 n)."""


def joint_covariance(
    linear: gtsam.GaussianFactorGraph, values: gtsam.Values, instead: JointCovariance
) -> JointCovariance:
    """Return the marginal covariances of the sensors of a linear graph.

    GTSAM's marginals are made by Cholesky. They call a system indeterminate where a direction is
    4,000 times better known than its neighbour, though it is not.

    Parameters
    ----------
    linear, values
        The graph, and where it was linearised.
    instead
        What gives them where GTSAM refuses.
    """
    try:
        marginals = gtsam.Marginals(linear, values)
    except RuntimeError as error:
        if not refused(error):
            raise
        return instead

    def among(sensors: tuple[int, ...]) -> FloatArray:
        keys = [key for sensor in sensors for key in keys_of(sensor)]
        joint = marginals.jointMarginalCovariance(keys)
        return np.asarray(np.block([[joint.at(a, b) for b in keys] for a in keys]))

    return among


def covariance_by_qr(linear: gtsam.GaussianFactorGraph, sensors: tuple[int, ...]) -> FloatArray:
    """Return the marginal covariance of sensors that factors connect, by QR, (16 n, 16 n)."""
    cluster = next(each for each in clusters_of(linear, sensors_in(linear)) if sensors[0] in each)
    ordering = gtsam.Ordering()
    for key in columns_of(cluster):
        ordering.push_back(key)
    own = gtsam.GaussianFactorGraph()
    for index in range(linear.size()):
        if set(linear.at(index).keys()) <= set(columns_of(cluster)):
            own.push_back(linear.at(index))
    jacobian, _ = own.jacobian(ordering)
    scale = 1 / np.linalg.norm(jacobian, axis=0)
    triangular = np.asarray(np.linalg.qr(jacobian * scale, mode="r"))
    root = scale[:, None] * solve_triangular(triangular, np.eye(len(scale)))
    at = columns_among(cluster, sensors)
    return np.asarray(root[at] @ root[at].T)


def clusters_of(linear: gtsam.GaussianFactorGraph, sensors: list[int]) -> list[tuple[int, ...]]:
    """Return the sensors in groups that no factor connects; each by itself where none do."""
    owner = {key(sensor): row for row, sensor in enumerate(sensors) for key in PLACES}
    pairs = [(0, 0)]
    for index in range(linear.size()):
        rows = sorted({owner[key] for key in list(linear.at(index).keys()) if key in owner})
        pairs += [(rows[0], row) for row in rows[1:]]
    at = np.array(pairs).T
    count = len(sensors)
    edges = coo_array((np.ones(at.shape[1]), (at[0], at[1])), shape=(count, count))
    _, labels = connected_components(edges, directed=False)
    named = np.array(sensors)
    return [tuple(named[labels == label].tolist()) for label in range(labels.max() + 1)]


def sensors_in(linear: gtsam.GaussianFactorGraph) -> list[int]:
    """Return the sensors whose positions are variables of a graph."""
    keys = {key for index in range(linear.size()) for key in list(linear.at(index).keys())}
    symbols = (gtsam.Symbol(key) for key in keys)
    return sorted(int(each.index()) for each in symbols if each.key() == T(each.index()))

"""What is read on a key pose, and what scans say of it, beside what is expected."""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_factors import CarriedReadings, CarriedResiduals, carried_residuals
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.graph.slam.belief import POSE, SENSOR, Belief, Evidence
from l2m_gtsam.graph.slam.factors import root_information
from l2m_gtsam.graph.slam.remembered import RememberedVariance
from l2m_gtsam.graph.slam.sight import Sight, place
from l2m_gtsam.graph.view import QueryableMap
from l2m_gtsam.solve.robust import WEIGHTS, RobustOptions


@dataclass(frozen=True)
class Passed:
    """Readings of a key pose that pass for such.

    Attributes
    ----------
    rows
        Which, shape (n,).
    whitening
        Of each, 1/uT, shape (n, 3, 3).
    """

    rows: IntArray
    whitening: FloatArray


def residuals_at(
    readings: CarriedReadings, field_map: QueryableMap, belief: Belief
) -> CarriedResiduals:
    """Compare n readings on one key pose with what a map predicts from a belief."""
    n, pose = len(readings), belief.pose
    R, p = np.tile(pose.rotation().matrix(), (n, 1, 1)), np.tile(pose.translation(), (n, 1))
    return carried_residuals(readings, field_map, R, p, belief.sensors.fixed())


def passed(
    readings: CarriedReadings,
    field_map: QueryableMap,
    variance: RememberedVariance,
    belief: Belief,
    robust: RobustOptions,
) -> Passed:
    """Return the readings on a key pose that a belief explains, by what it and they may be off."""
    seen, sensors = residuals_at(readings, field_map, belief), belief.sensors
    where = place(readings, {int(readings.key_pose[0]): belief.pose}, sensors)
    known = variance.at(where.x)
    sight = Sight(where, np.isfinite(known[:, 0]), known, seen.reading.residual)
    spread = spread_of(seen, readings.sensor, belief.covariance)
    r2 = sight.squared(sight.whitening(sensors.noise, more=spread))
    trust = WEIGHTS[robust.loss](r2, robust.largest, np.inf)
    rows = np.flatnonzero(sight.inside & (trust > 0))
    W = sight.whitening(sensors.noise) * np.sqrt(trust)[:, None, None]
    return Passed(rows, W[rows])


def spread_of(seen: CarriedResiduals, sensor: IntArray, covariance: FloatArray) -> FloatArray:
    """Return what an uncertain belief adds to the covariance of residuals, uT^2, (n, 3, 3).

    Parameters
    ----------
    seen
        Residuals of n readings.
    sensor
        Of which sensor each is, shape (n,).
    covariance
        Of the belief, shape (P, P).
    """
    J, P = seen.de_dX, covariance
    if len(P) > POSE:
        J = np.concatenate([J, seen.reading.de_dt, seen.reading.de_dD], axis=2)
        at = np.hstack([np.tile(np.arange(POSE), (len(sensor), 1)), columns_of(sensor)])
        P = P[at[:, :, None], at[:, None, :]]
    return np.asarray(J @ P @ J.transpose(0, 2, 1))


def evidence(
    readings: CarriedReadings, field_map: QueryableMap, W: FloatArray, belief: Belief
) -> Evidence:
    """Return n readings on one key pose as evidence, whitened by W, shape (n, 3, 3)."""
    seen, n = residuals_at(readings, field_map, belief), len(readings)
    J = np.zeros((n, 3, len(belief.covariance)))
    J[:, :, :POSE] = W @ seen.de_dX
    if len(belief.covariance) > POSE:
        by_sensor = W @ np.concatenate([seen.reading.de_dt, seen.reading.de_dD], axis=2)
        at = np.arange(n)[:, None, None], np.arange(3)[:, None]
        J[(*at, columns_of(readings.sensor)[:, None])] = by_sensor
    r = np.einsum("nij,nj->ni", W, seen.reading.residual)
    return Evidence(r.ravel(), J.reshape(3 * n, -1))


def fix_evidence(fix: gtsam.Pose3, covariance: FloatArray, belief: Belief) -> Evidence:
    """Return a key pose's place in the map, with its covariance (6, 6), as evidence."""
    W = root_information(covariance)
    J = np.zeros((POSE, len(belief.covariance)))
    J[:, :POSE] = W
    return Evidence(W @ gtsam.Pose3.Logmap(fix.between(belief.pose)), J)


def columns_of(sensor: IntArray) -> IntArray:
    """Return which components of a belief are those of each reading's sensor, shape (n, 15)."""
    return np.asarray(POSE + SENSOR * sensor[:, None] + np.arange(SENSOR))

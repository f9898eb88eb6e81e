"""Magnetic SLAM by GTSAM's ``IncrementalFixedLagSmoother``: what a user of GTSAM would begin with.

Field, noise and steps are those of :mod:`l2m_gtsam.studies.peers.reduced_rank_ekf`. Poses are
smoothed over the lag and marginalised then; the weights of the field stay.
"""

from dataclasses import replace

import gtsam
import numpy as np
from pydantic import Field

from l2m_factors import X, fixed_axes_step_factor, skew
from l2m_factors.field_map import Jacobians
from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.maps.potential import PotentialBasis
from l2m_gtsam.options import Options
from l2m_gtsam.studies.peers.reduced_rank_ekf import ReducedRankEkfOptions

WEIGHTS = gtsam.symbol("w", 0)
SURE = 1e-4  # metres and rad: the start is exact
SECOND = 1e-9


class FixedLagOptions(Options):
    """Parameters of the smoother beside those of the field, the noise and the steps."""

    lag_s: float = Field(default=30.0, gt=0)
    """How long a pose stays a variable."""
    relinearise: float = Field(default=0.3, gt=0)
    """Change of a variable from which it is linearised again. What was marginalised is not, and
    contradicts what is: on the ship, 0.1 and 1 leave more error than 0.3."""


def fixed_lag_slam(
    odometry: Trajectory,
    field: FloatArray,
    box: FloatArray,
    model: ReducedRankEkfOptions,
    options: FixedLagOptions,
) -> Trajectory:
    """Return the smoother's estimate of each pose, with its covariance, when it is made.

    Parameters
    ----------
    odometry
        N poses, one for each reading. The first is the start, which is exact.
    field
        Readings along the axes of the vehicle in uT, shape (N, 3).
    box
        Lower and upper corner of the path in metres, shape (2, 3).
    model
        Field, noise and errors of steps.
    options
        Lag and linearisation.
    """
    basis = model.basis_about(box)
    smoother = _smoother(options)
    seconds = SECOND * (odometry.stamp_ns - odometry.stamp_ns[0])
    pose = gtsam.Pose3(gtsam.Rot3(odometry.R[0]), odometry.p[0])
    found = [pose]
    covariance = [SURE**2 * np.eye(6)]
    priors, start = _beginning(pose, len(basis))
    smoother.update(priors, start, {X(0): 0.0, WEIGHTS: 0.0})
    for k in range(1, len(odometry)):
        turn, way = odometry.R[k] @ odometry.R[k - 1].T, odometry.p[k] - odometry.p[k - 1]
        before = found[-1]
        predicted = gtsam.Pose3(
            gtsam.Rot3(turn @ before.rotation().matrix()), before.translation() + way
        )
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(k), predicted)
        noise = step_noise(odometry.R[k], model)
        graph.add(fixed_axes_step_factor(k - 1, gtsam.Rot3(turn), way, noise))
        graph.add(reading_of_field(basis, X(k), field[k], model.noise_ut))
        smoother.update(graph, values, {X(k): seconds[k], WEIGHTS: seconds[k]})
        found.append(smoother.calculateEstimatePose3(X(k)))
        covariance.append(smoother.marginalCovariance(X(k)))
    return replace(
        odometry,
        R=np.stack([each.rotation().matrix() for each in found]),
        p=np.stack([each.translation() for each in found]),
        covariance=np.stack(covariance),
    )


def reading_of_field(
    basis: PotentialBasis, pose: int, reading: FloatArray, noise_ut: float
) -> gtsam.CustomFactor:
    r"""Return a reading z at a pose in a field of weights u that have unit prior.

    Along the axes of the world ``e = A(p) S u - R z``, with the standard deviations S of the prior.
    """
    sigma = np.sqrt(basis.variance)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Jacobians) -> FloatArray:
        at, u = values.atPose3(pose), values.atVector(WEIGHTS)
        place, R = at.translation()[None], at.rotation().matrix()
        features = basis.features(place)[0] * sigma
        if jacobians is not None:
            gradient = basis.slopes(place)[0] @ (sigma * u)
            jacobians[0] = np.hstack([R @ skew(reading[None])[0], gradient @ R])
            jacobians[1] = features
        return np.asarray(features @ u - R @ reading)

    noise = gtsam.noiseModel.Isotropic.Sigma(3, noise_ut)
    return gtsam.CustomFactor(noise, [pose, WEIGHTS], error)


def step_noise(R: FloatArray, model: ReducedRankEkfOptions) -> gtsam.noiseModel.Base:
    """Return the errors of a step as a right perturbation of a pose with rotation R."""
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = model.turn_variance * np.eye(3)
    along = np.diag([model.level_variance, model.level_variance, model.vertical_variance])
    covariance[3:, 3:] = R.T @ along @ R
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _smoother(options: FixedLagOptions) -> gtsam.IncrementalFixedLagSmoother:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(options.relinearise)
    params.relinearizeSkip = 1
    return gtsam.IncrementalFixedLagSmoother(options.lag_s, params)


def _beginning(start: gtsam.Pose3, weights: int) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return priors and values of the exact start and of the weights."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    exact = gtsam.noiseModel.Isotropic.Sigma(6, SURE)
    graph.add(gtsam.PriorFactorPose3(X(0), start, exact))
    unit = gtsam.noiseModel.Unit.Create(weights)
    graph.add(gtsam.PriorFactorVector(WEIGHTS, np.zeros(weights), unit))
    values.insert(X(0), start)
    values.insert(WEIGHTS, np.zeros(weights))
    return graph, values

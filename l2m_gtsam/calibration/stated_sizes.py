"""How large errors are beside what was stated of them: by the likelihood of the same readings.

What is stated enters the graph as it is. That it is wrong shows in the weights of the errors, which
are then larger or smaller than their prior has them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_gtsam.calibration.joint_information import JointInformation
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.records.error_budget import FACTOR, ErrorCause, StatedSize
from l2m_gtsam.solve.linear_algebra import submatrix
from l2m_gtsam.solve.noise import NOISE_RANGE
from l2m_gtsam.solve.variance_components import WeightSystem

NOTHING_LEFT = 2 * NOISE_RANGE[0]  # uT
HIDDEN = 0.5  # of the noise that neighbours show: less is no estimate of it
SMALLEST = 0.01  # of what was stated


def size_of_noise(sensor: str, stated: float, found: float, freedom: float) -> StatedSize:
    """Return how large a sensor's noise is beside what was stated.

    Parameters
    ----------
    sensor
        Its name.
    stated, found
        Standard deviations in uT, the second as the residuals show it.
    freedom
        Values that it was found from.
    """
    squared = (found / stated) ** 2
    gain = freedom * (squared - 1 - np.log(squared))
    return StatedSize(ErrorCause.NOISE, found / stated, float(gain), sensor)


@dataclass(frozen=True)
class NoiseBesidePoses:
    """A sensor's residuals beside what errors of poses are stated to leave of them.

    Attributes
    ----------
    residual
        In order of time in uT, shape (N, 3).
    noise
        Standard deviation of the sensor's noise that is left beside them in uT.
    of_poses
        Mean variance that they leave to a reading in uT^2.
    """

    residual: FloatArray
    noise: float
    of_poses: float

    @property
    def scatter(self) -> float:
        """Standard deviation by neighbours, which errors that last have in common, uT."""
        return float(np.sqrt(np.mean(np.diff(self.residual, axis=0) ** 2) / 2))

    @property
    def is_hidden(self) -> bool:
        """Whether errors of poses take the place of the noise that neighbours show."""
        return self.noise < HIDDEN * self.scatter


def size_beside_noise(sensors: Sequence[NoiseBesidePoses]) -> StatedSize | None:
    """Return how large errors of poses are that leave no room for noise; None if they leave some.

    Noise is then estimated as next to nothing, and what weights of the errors say means nothing.
    """
    hidden = [each for each in sensors if each.is_hidden]
    if not hidden:
        return None
    left = sum(float(np.mean(each.residual**2)) - each.scatter**2 for each in hidden)
    squared = max(left, 0.0) / sum(each.of_poses for each in hidden)
    freedom = sum(each.residual.size for each in hidden)
    ratio = max(float(np.sqrt(squared)), SMALLEST)
    return StatedSize(ErrorCause.POSES, ratio, freedom * (ratio**2 - 1 - 2 * float(np.log(ratio))))


def leave_noise(stated: Sequence[StatedSize], noise: FloatArray) -> bool:
    """Return whether errors as they were stated leave noise by which others can be found.

    Where they are too large and explain all that a sensor reads, what is left is rounding.

    Parameters
    ----------
    stated
        What the readings show of them.
    noise
        Of each sensor, as estimated beside them, uT, shape (S,).
    """
    too_large = any(each.is_wrong and each.ratio < 1 for each in stated)
    return not (too_large and take_all_noise(noise))


def noise_is_short(stated: Sequence[StatedSize]) -> bool:
    """Return whether noise was stated so small that all that is found would be noise."""
    return any(e.cause is ErrorCause.NOISE and e.is_wrong and e.ratio > 1 for e in stated)


def poses_too_small(stated: Sequence[StatedSize]) -> bool:
    """Return whether errors of poses are larger than was stated."""
    return any(e.cause is ErrorCause.POSES and e.is_wrong and e.ratio > 1 for e in stated)


def shown_by_one(
    stated: Sequence[StatedSize], without: Sequence[StatedSize], sensor: str
) -> tuple[StatedSize, ...]:
    """Return sizes where errors of poses that a sensor alone shows are said of that sensor.

    What is wrong with poses shows in all sensors.

    Parameters
    ----------
    stated, without
        What all sensors show, and what those without it do.
    sensor
        Its name.
    """
    poses = [each for each in without if each.cause is ErrorCause.POSES]
    if not poses or any(each.ratio >= FACTOR for each in poses):
        return tuple(stated)
    return tuple(
        replace(each, sensor=sensor) if each.cause is ErrorCause.POSES else each for each in stated
    )


def beside_processes(
    stated: Sequence[StatedSize], sensors: Sequence[str], left: FloatArray
) -> tuple[StatedSize, ...]:
    """Return sizes with the noise that processes leave, as shares of what readings showed, (S,)."""
    share = dict(zip(sensors, left.tolist(), strict=True))
    return tuple(
        replace(each, ratio=each.ratio * share[each.sensor]) if each.sensor else each
        for each in stated
    )


def take_all_noise(noise: FloatArray) -> bool:
    """Return whether errors of stated sizes leave a sensor no noise, shape (S,) in uT."""
    return bool((noise <= NOTHING_LEFT).any())


def size_of_shared(
    cause: ErrorCause, joint: JointInformation, at: IntArray, prior: FloatArray, weights: FloatArray
) -> StatedSize:
    """Return how large errors that readings share are beside their prior.

    Parameters
    ----------
    cause
        Whose errors.
    joint
        All variables at the optimum.
    at
        Where the errors' K weights stand among them, shape (K,).
    prior
        Their information before any reading, shape (K, K).
    weights
        Their most likely values, shape (K,).
    """
    system = without_prior(submatrix(joint.every, at), prior, weights)
    found = system.components(np.ones((1, len(at))))
    as_stated = system.fit(np.ones(len(at))).likelihood
    return StatedSize(cause, float(np.sqrt(found.sizes[0])), found.gain - 2 * as_stated)


def without_prior(covariance: FloatArray, prior: FloatArray, mean: FloatArray) -> WeightSystem:
    """Return what readings alone say of K weights, in units in which their prior is one.

    Parameters
    ----------
    covariance, mean
        Of the weights by readings and prior together, shapes (K, K) and (K,).
    prior
        Information of the prior, shape (K, K).
    """
    # With prior = L L^T the weights v = L^T w have unit variance before any reading.
    L = cholesky(prior, lower=True)
    root = solve_triangular(cholesky(covariance, lower=True), np.eye(len(mean)), lower=True)
    white = solve_triangular(L, (root.T @ root) @ mean, lower=True)
    half = solve_triangular(L, root.T, lower=True)
    information = half @ half.T - np.eye(len(mean))
    return WeightSystem(0.5 * (information + information.T), white)

r"""A slow error of one sensor's readings: an Ornstein-Uhlenbeck process.

Readings are off by ``s n(t)``, with n of unit variance and ``E n(t) n(t') = exp(-|t - t'| / tau)``
along each axis of the sensor. t is the time of what lasts, as of motors and thrusters, or the path
to detail of the field that a model does not hold; tau has the same unit. Its values at the key
poses are variables ``N(k)``, a Markov chain

.. math::
    n_{k+1} = a n_k + \sqrt{1 - a^2} \, w, \quad a = \exp(-\Delta / \tau), \quad w \sim N(0, I)

and between two key poses, ``\Delta`` apart, a after the first and b before the second,

.. math::
    E[n(t)] = \frac{\sinh(b / \tau) n_k + \sinh(a / \tau) n_{k+1}}{\sinh(\Delta / \tau)}

(C. Rasmussen, C. Williams, "Gaussian processes for machine learning", 2006, appendix B). Without
it readings of the same error count as so many independent ones: sigmas are too small.
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from l2m_factors.arguments import numbers
from l2m_factors.field_map import FloatArray
from l2m_factors.keys import N

AXES = 3
LEAST = 1e-6  # between two key poses, seconds or metres


@dataclass(frozen=True)
class SlowError:
    """What n readings between a key pose and the next have of the slow error at both.

    Attributes
    ----------
    key_pose
        Number k of the key pose before them.
    shares
        What a unit of the error at the one and at the other adds to each, uT, shape (n, 2).
    """

    key_pose: int
    shares: FloatArray

    def checked(self, count: int) -> "SlowError":
        """Return a copy for so many readings; a ValueError if it is of another number of them."""
        return SlowError(self.key_pose, numbers("SlowError.shares", self.shares, (count, 2)))

    @cached_property
    def keys(self) -> list[int]:
        """The error at both key poses."""
        return [N(self.key_pose), N(self.key_pose + 1)]

    def residual(self, values: gtsam.Values) -> FloatArray:
        """Return what is added in uT, shape (n, 3)."""
        return self.shares @ np.stack([values.atVector(key) for key in self.keys])

    def jacobians(self, _: gtsam.Values) -> list[FloatArray]:
        """Return its derivatives by the error at both key poses, shape (n, 3, 3) each."""
        return [share[:, None, None] * np.eye(AXES) for share in self.shares.T]


@dataclass(frozen=True)
class SlowBridge:
    """The slow error at n readings between two key poses, in its standard deviations.

    Attributes
    ----------
    shares
        Of the error at both key poses in its mean, shape (n, 2).
    covariance
        Of what remains, shape (n, n).
    """

    shares: FloatArray
    covariance: FloatArray


def slow_bridge(before: FloatArray, after: FloatArray, tau: float) -> SlowBridge:
    """Return what the errors at two key poses say of those between them.

    Parameters
    ----------
    before, after
        Time or path from the first key pose to each reading, and from there to the second,
        shapes (n,).
    tau
        Time or path over which the error changes.
    """
    a, b = before / tau, after / tau
    whole = np.expm1(-2 * np.maximum(a + b, LEAST / tau))
    shares = np.column_stack([np.exp(-a) * np.expm1(-2 * b), np.exp(-b) * np.expm1(-2 * a)])
    shares = shares / whole[:, None]
    alike = np.exp(-np.abs(np.subtract.outer(a, a)))
    covariance = alike - shares @ np.exp(-np.stack([a, b]))
    return SlowBridge(shares, 0.5 * (covariance + covariance.T))


def slow_error_graph(key_poses: FloatArray, tau: float) -> gtsam.NonlinearFactorGraph:
    """Return the prior of the errors ``N(k)`` at K key poses.

    Parameters
    ----------
    key_poses
        Their times, or the path to them, shape (K,).
    tau
        Time or path over which the error changes.
    """
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(AXES)
    graph.add(gtsam.PriorFactorVector(N(0), np.zeros(AXES), unit))
    decays = np.exp(-np.maximum(np.diff(key_poses), LEAST) / tau)
    for k, a in enumerate(decays.tolist()):
        root = np.eye(AXES) / np.sqrt(1 - a**2)
        linear = gtsam.JacobianFactor(N(k), -a * root, N(k + 1), root, np.zeros(AXES), unit)
        graph.add(gtsam.LinearContainerFactor(linear, zero_errors((N(k), N(k + 1)))))
    return graph


def zero_errors(keys: tuple[int, ...]) -> gtsam.Values:
    """Return no errors: without them as its point a linear factor counts its values as zero."""
    values = gtsam.Values()
    for key in keys:
        values.insert(key, np.zeros(AXES))
    return values

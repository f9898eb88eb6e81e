"""Priors that the readings speak against.

A prior that disagrees pulls the estimate towards itself, so that little may be left to see of it:
what is left is compared with how large it would be if the prior were true, `I - J P J^T` with the
prior's white rows J and the covariance P of the solution. That is the test of its innovation.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from l2m_gtsam.calibration.marginals import JointCovariance
from l2m_gtsam.calibration.priors import Prior, prior_rows

LARGEST = 4.0  # sigmas
# Share of a prior's variance that is not its own doing; with less nothing else informs about it.
INFORMED = 1e-3


@dataclass(frozen=True)
class Contradiction:
    """What is known beforehand of which sensors, and by how many sigmas the readings differ."""

    kind: str
    sensors: tuple[int, ...]
    sigmas: float


def contradictions(
    priors: tuple[Prior, ...], values: gtsam.Values, covariance: JointCovariance
) -> tuple[Contradiction, ...]:
    """Return the priors that the readings and all other priors speak against.

    Parameters
    ----------
    priors
        Of sensors that are solved.
    values
        The solution.
    covariance
        Of it.
    """
    missed = (Contradiction(p.kind, p.sensors, sigmas(p, values, covariance)) for p in priors)
    return tuple(each for each in missed if each.sigmas > LARGEST)


def sigmas(prior: Prior, values: gtsam.Values, covariance: JointCovariance) -> float:
    """Return by how many standard deviations all else differs from a prior, in its worst row."""
    jacobian, b = prior_rows(prior, values, prior.sensors)
    own = np.einsum("ij,jk,ik->i", jacobian, covariance(prior.sensors), jacobian)
    informed = 1 - own > INFORMED
    return float(np.max(np.abs(b[informed]) / np.sqrt(1 - own[informed]), initial=0.0))

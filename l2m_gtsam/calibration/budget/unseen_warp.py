r"""A bend of the drive's frame that its readings do not show: what it may do to an estimate.

Frames of two drives by SLAM never agree. A bend that explains the drive is found and estimated
(``search``); a smaller one is not in the graph, and its errors are counted all the same, as those
of a parameter that is considered and not estimated (Schmidt, Advances in Control Systems 3, 1966).

With the spectrum of the bend taken into its weights w, and these along the eigenvectors of what
readings say of them, information is :math:`\lambda_j`, pull :math:`g_j`, the prior variance of each
:math:`s^2`, and

.. math::
    \ell(s) = \tfrac12 \sum_j \frac{s^2 g_j^2}{1 + s^2 \lambda_j} - \log(1 + s^2 \lambda_j)

the log likelihood of a size s, restricted for everything else. Beforehand s is half normal. Its
posterior p gives the second moments of the weights, whatever the size is:

.. math::
    \mathrm E\,w w^T = \int p(s) \Bigl[\mathrm{diag}\,\frac{s^2}{1 + s^2 \lambda_j}
        + m(s)\,m(s)^T\Bigr] ds, \qquad m_j = \frac{s^2 g_j}{1 + s^2 \lambda_j}

An estimate without them is off by B w, with what a unit of each moves it by.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky

from l2m_gtsam.calibration.budget.search import ProcessInformation
from l2m_gtsam.data import FloatArray

SMALLEST, LARGEST, SIZES = 1e-3, 5.0, 120  # of the size beforehand; the grid is geometric


@dataclass(frozen=True)
class UnseenWarp:
    """A bend that is in no graph.

    Attributes
    ----------
    size_m
        Root mean square of its shifts along each axis of the floor, by its posterior, metres.
    root
        Of the covariance that it adds to all n variables of the graph, shape (n, m).
    """

    size_m: float
    root: FloatArray


def unseen_warp(known: ProcessInformation, before_m: float) -> UnseenWarp:
    """Return what a bend may do that readings leave possible.

    Parameters
    ----------
    known
        What readings say of a warp, and of nothing else.
    before_m
        How large it is beforehand: standard deviation of shifts in metres.
    """
    informed, pull, of_estimate = warp_modes(known)
    posterior, variance, rms = posterior_of(informed, np.square(pull), before_m)
    mean = variance * pull
    moments = np.diag(posterior @ variance) + (mean.T * posterior) @ mean
    return UnseenWarp(rms, of_estimate @ cholesky(moments, lower=True))


def foretold_warp(known: ProcessInformation, before_m: float) -> UnseenWarp:
    """Return what that will be on a drive that is yet to be read, along a frame that is not bent.

    Noise alone pulls at each eigenvector by the root of its information. Parameters are those of
    ``unseen_warp``, the pull being nothing.
    """
    informed, _, of_estimate = warp_modes(known)
    posterior, variance, rms = posterior_of(informed, informed, before_m)
    moments = posterior @ (variance + np.square(variance) * informed)
    return UnseenWarp(rms, of_estimate * np.sqrt(moments))


def warp_modes(known: ProcessInformation) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a warp of unit size along the eigenvectors of what readings say of its weights.

    Returns
    -------
    informed, pull
        Information and pull of each, shapes (m,).
    of_estimate
        What a unit of each moves all variables of the graph by, shape (n, m).
    """
    (warp,) = known.processes  # nothing else is looked for
    unit = np.sqrt(warp.forms[0].mean(axis=0))  # both lengths alike
    informed, axes = np.linalg.eigh(unit[:, None] * known.system.information * unit)
    pull = axes.T @ (unit * known.system.pull)
    return np.maximum(informed, 0.0), pull, known.influence @ (unit[:, None] * axes)


def posterior_of(
    informed: FloatArray, squared_pull: FloatArray, before_m: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the posterior of a warp's size on a grid, by what is known of its modes, shapes (m,).

    Returns
    -------
    posterior
        How likely each size is, shape (G,).
    variance
        Of each mode where the size is known, shape (G, m).
    rms
        Root mean square of the size, metres.
    """
    size = before_m * np.geomspace(SMALLEST, LARGEST, SIZES)
    prior = np.square(size)[:, None]
    variance = prior / (1 + prior * informed)
    likelihood = 0.5 * (squared_pull * variance - np.log1p(prior * informed)).sum(axis=1)
    beforehand = -0.5 * np.square(size / before_m)
    # The steps of a geometric grid are as long as the sizes.
    posterior = size * np.exp(likelihood - likelihood.max() + beforehand)
    posterior /= posterior.sum()
    return posterior, variance, float(np.sqrt(posterior @ np.square(size)))

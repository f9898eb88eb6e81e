r"""Sizes of several processes whose weights a linear system has in common, by their likelihood.

Readings that are white after all else is taken out say of m weights w an information I and a pull
u. With independent weights of variances :math:`S = \sum_k \theta_k d_k`, a spectrum d_k for each
process, the logarithm of the likelihood, restricted for all else, exceeds that without weights by

.. math::
    \ell(\theta) = \tfrac12 u^T (S^{-1} + I)^{-1} u
        - \tfrac12 \log\det(1 + S^{1/2} I S^{1/2})

The sizes are found by the updates of Zhou, Hu, Qiao and Cho (MM algorithms for variance components,
JCGS 28, 2019), each of which raises it and keeps all sizes positive:

.. math::
    \theta_k \leftarrow \theta_k
        \sqrt{\frac{q^T d_k q}{\mathrm{tr}\, d_k M}}, \qquad
    M = (1 + I S)^{-1} I, \quad q = (1 + I S)^{-1} u
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dtrtri

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.solve.minimum import minimised

MOST_UPDATES = 200
ENOUGH = 0.02  # of a logarithm of likelihood: less than that in an update is no progress
LARGEST = 1e6  # of the size of a process that says as much as a single reading
ROUNDS = 3  # of sizes and noise; they settle in two
LEAST_NOISE = 0.05  # of its variance
ROUNDING = 1e-13  # of the largest information: what has less is a zero that was summed
NEGLIGIBLE = 1e-3  # of a single weight's information: what a process says that is nothing


@dataclass(frozen=True)
class Climb:
    """How far to climb over the logarithms of all sizes.

    Attributes
    ----------
    steps
        The most of them.
    tolerance
        Relative rise of the likelihood in a step that ends it.
    """

    steps: int
    tolerance: float


SHORT = Climb(12, 1e-4)
TO_THE_TOP = Climb(30, 1e-7)  # where it counts by how much a process is the best explanation


@dataclass(frozen=True)
class VarianceComponents:
    """The most likely sizes.

    Attributes
    ----------
    sizes
        Variances theta of K processes, shape (K,); zero where none is there.
    gain
        Twice the logarithm of the likelihood beyond that without any of them.
    noise
        Share of the noise's variance that is left beside them.
    """

    sizes: FloatArray
    gain: float
    noise: float = 1.0


@dataclass(frozen=True)
class WeightFit:
    """What a prior of weights is worth.

    Attributes
    ----------
    likelihood
        Its logarithm beyond that without weights.
    rest
        q, what the pull is that the weights leave, shape (m,).
    share
        How much of each weight's prior variance the readings take away, shape (m,).
    """

    likelihood: float
    rest: FloatArray
    share: FloatArray


@dataclass(frozen=True)
class WeightSystem:
    """What readings say of m weights, before any prior of these.

    Attributes
    ----------
    information
        I, shape (m, m).
    pull
        u, shape (m,): the weights that fit best are ``I^-1 u``.
    """

    information: FloatArray
    pull: FloatArray

    def among(self, at: IntArray) -> "WeightSystem":
        """Return the same for some weights, the others being zero."""
        return WeightSystem(self.information[np.ix_(at, at)], self.pull[at])

    def beside(self, variances: FloatArray) -> "WeightSystem":
        """Return the same where weights may be as large as these variances, shape (m,), by others.

        What is left of the weights is what they are beyond that.
        """
        return self.left_to(variances, np.arange(len(self.pull)))

    def left_to(self, variances: FloatArray, at: IntArray) -> "WeightSystem":
        """Return ``beside(variances).among(at)``, at the cost of these weights only."""
        may = np.flatnonzero(variances > 0)
        root = np.sqrt(variances[may])
        lower = self.among(may)._factor(root)
        own = np.column_stack([self.information[np.ix_(may, at)], self.pull[may]])
        white = solve_triangular(lower, root[:, None] * own, lower=True, check_finite=False)
        Z, v = white[:, :-1], white[:, -1]
        return WeightSystem(self.information[np.ix_(at, at)] - Z.T @ Z, self.pull[at] - Z.T @ v)

    def fit(self, variances: FloatArray) -> WeightFit:
        """Return what a prior of these variances, shape (m,), is worth.

        With ``K = (1 + S^1/2 I S^1/2)^-1`` it is ``S^1/2 M S^1/2 = 1 - K``.
        """
        root = np.sqrt(variances)
        lower = self._factor(root)
        likelihood = -float(np.log(np.diag(lower)).sum())
        inverse, _ = dtrtri(lower, lower=1, overwrite_c=1)
        white = inverse @ (root * self.pull)
        rest = self.pull - self.information @ (root * (inverse.T @ white))
        share = 1 - np.einsum("ij,ij->j", inverse, inverse)
        return WeightFit(likelihood + 0.5 * float(white @ white), rest, share)

    def _factor(self, root: FloatArray) -> FloatArray:
        """Return the lower Cholesky factor of ``1 + S^1/2 I S^1/2``, in Fortran order, (m, m)."""
        try:
            return _factor_of(self.information, root)
        except np.linalg.LinAlgError:
            # A difference of informations that rounding made indefinite.
            values, axes = np.linalg.eigh(self.information)
            return _factor_of((axes * np.maximum(values, 0.0)) @ axes.T, root)

    def scores(self, spectra: FloatArray) -> FloatArray:
        """Return how far K processes of these spectra, (K, m), are from not being there, (K,).

        In standard deviations of what would be seen of them then; the square is about the gain.
        """
        found = spectra @ (self.pull**2 - np.diag(self.information))
        spread = 2 * np.einsum("ki,ij,kj->k", spectra, self.information**2, spectra)
        return np.asarray(found / np.sqrt(np.where(spread > 0, spread, 1.0)))

    def components(self, spectra: FloatArray) -> VarianceComponents:
        """Return the most likely sizes of K processes of these spectra, shape (K, m)."""
        alone = np.diag(self.information)
        expected = spectra @ alone
        count = np.count_nonzero(spectra, axis=1)
        shows = expected > ROUNDING * spectra.sum(axis=1) * alone.max(initial=0.0)
        sizes = np.where(shows, count / np.where(shows, expected, 1.0), 0.0)
        most, last = LARGEST * sizes, -np.inf
        for _ in range(MOST_UPDATES):
            variances = sizes @ spectra
            found = self.fit(variances)
            if found.likelihood - last < ENOUGH:
                break
            last = found.likelihood
            known = found.share / np.where(variances > 0, variances, 1.0)  # the diagonal of M
            informed = spectra @ known
            ratio = (spectra @ found.rest**2) / np.where(informed > 0, informed, 1.0)
            sizes = np.minimum(sizes * np.sqrt(np.where(informed > 0, ratio, 0.0)), most)
            sizes = np.where(sizes * expected > NEGLIGIBLE, sizes, 0.0)
        return VarianceComponents(sizes, 2 * self.fit(sizes @ spectra).likelihood)

    def whiter(self, noise: float) -> "WeightSystem":
        """Return the same where the noise has this share of its variance only."""
        return WeightSystem(self.information / noise, self.pull / noise)

    def components_and_noise(
        self, spectra: FloatArray, squares: float, chance: FloatArray | float = 0.0
    ) -> VarianceComponents:
        """Return the most likely sizes where what they explain is no noise.

        Parameters
        ----------
        spectra
            Of K processes, shape (K, m).
        squares
            Sum of squares of all residuals, white by a noise that has all of that in it.
        chance
            Pull that is expected of such a noise without any weight, shape (m,).
        """
        noise = 1.0
        for _ in range(ROUNDS):
            beyond = replace(self, pull=self.pull - noise * chance)
            system = beyond.whiter(noise)
            found = replace(system.components(spectra), noise=noise)
            variances = found.sizes @ spectra
            explained = beyond.pull @ (variances * system.fit(variances).rest)
            noise = max(1 - float(explained) / squares, LEAST_NOISE)
        return found


def _factor_of(information: FloatArray, root: FloatArray) -> FloatArray:
    inner = root[:, None] * information * root
    inner[np.diag_indices_from(inner)] += 1.0
    return np.asarray(cholesky(inner.T, lower=True, overwrite_a=True, check_finite=False))


def shared_components(
    systems: Sequence[WeightSystem],
    spectra: Sequence[FloatArray],
    squares: float | None,
    climb: Climb = SHORT,
    near: FloatArray | None = None,
) -> VarianceComponents:
    """Return the most likely sizes of K processes that several systems have, each with own weights.

    Climbs with all of them at once (L-BFGS), for hundreds of weights in few steps.

    Parameters
    ----------
    systems
        Of weights that are independent from one to the next.
    spectra
        Of the processes in each, shapes (K, m).
    squares
        As in ``WeightSystem.components_and_noise``; where absent, the noise is known.
    climb
        How far, in the last of ``ROUNDS`` rounds; those before it settle the noise.
    near
        Sizes to begin with, shape (K,); those of a process alone, if they are known.
    """
    expected = sum(d @ np.diag(each.information) for each, d in zip(systems, spectra, strict=True))
    count = sum(np.count_nonzero(d, axis=1) for d in spectra)
    unit = np.log(np.maximum(count, 1) / np.where(expected > 0, expected, 1.0))
    low, high = unit + np.log(NEGLIGIBLE), unit + np.log(LARGEST)
    start, noise = unit, 1.0
    if near is not None:
        # From zero no climb over logarithms comes back.
        known = np.log(np.where(near > 0, near, np.exp(unit)))
        start = np.clip(known, low, high)
    for round_ in range(ROUNDS):
        now = climb if squares is None or round_ == ROUNDS - 1 else SHORT
        white = [each.whiter(noise) for each in systems]
        cost = partial(_cost, white, spectra)
        end = minimised(cost, start, low, high, now.steps, now.tolerance)
        start = end.x
        sizes = np.where(start > unit + np.log(2 * NEGLIGIBLE), np.exp(start), 0.0)
        found = VarianceComponents(sizes, -2 * float(end.fun), noise)
        if squares is None:
            break
        noise = noise_left(systems, [sizes @ d for d in spectra], squares)
    return found


def noise_left(
    systems: Sequence[WeightSystem], variances: Sequence[FloatArray], squares: float
) -> float:
    """Return the share of the noise's variance that weights of known variances leave.

    Parameters
    ----------
    systems, squares
        As in ``shared_components``.
    variances
        Of the weights in each, shapes (m,).
    """
    noise = 1.0
    for _ in range(ROUNDS):
        explained = sum(
            float(own.pull @ (d * own.whiter(noise).fit(d).rest))
            for own, d in zip(systems, variances, strict=True)
        )
        noise = max(1 - explained / squares, LEAST_NOISE)
    return noise


def _cost(
    systems: Sequence[WeightSystem], spectra: Sequence[FloatArray], x: FloatArray
) -> tuple[float, FloatArray]:
    """Return the negative log likelihood of the logarithms of all sizes, and its slope, (K,)."""
    sizes, value, slope = np.exp(x), 0.0, np.zeros(len(x))
    for each, d in zip(systems, spectra, strict=True):
        variances = sizes @ d
        found = each.fit(variances)
        known = found.share / np.where(variances > 0, variances, 1.0)
        value += found.likelihood
        slope += 0.5 * sizes * (d @ (found.rest**2 - known))
    return -value, -slope

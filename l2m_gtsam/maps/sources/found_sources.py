"""Sources with their covariance, fitted by damped Gauss-Newton steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.source import HALF_AXIS, MOMENT, PARAMETERS, SourceShape

STEPS = 20  # of a refinement
SMALL_STEP = 0.01  # of a sigma squared: a refinement has ended
HALF_LENGTH_M = 0.5  # standard deviation of half a bar's length before readings
# Steel that comes and goes stands on the floor and is no higher than people move it: over the
# sensors, metres, mean and standard deviation.
HEIGHT_M = 0.5, 1.0
MOMENT_AM2 = 1000.0  # standard deviation of a moment beforehand: a lorry's
LONGEST_M = 0.3  # of a step of a refinement


@dataclass(frozen=True)
class FoundSources:
    """Sources with their covariance.

    Attributes
    ----------
    shapes
        The sources, K of them.
    root
        Of the covariance of their position, moment and half axis, source by source; what a dipole
        does not have is zero, shape (9 K, q).
    gains
        How much each explains that the others do not: twice the logarithm of the likelihood ratio,
        shape (K,).
    left
        Squared length of what all of them leave, white.
    evidence
        Twice the logarithm of the likelihood with all parameters integrated out, by Laplace's
        method, less what sources of all shapes have in common (Kass and Raftery 1995, eq. 5).
    wrong
        Readings that are wrong by themselves, which no source explains: they did not count.
    """

    shapes: tuple[SourceShape, ...]
    root: FloatArray
    gains: FloatArray
    left: float
    evidence: float
    wrong: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.shapes)

    @property
    def parameters(self) -> int:
        """Number of parameters of all of them."""
        return sum(int(_free(each).sum()) for each in self.shapes)

    @property
    def covariance(self) -> FloatArray:
        """Of the parameters of all of them, shape (9 K, 9 K)."""
        return np.asarray(self.root @ self.root.T)

    def field(self, points: FloatArray) -> FloatArray:
        """Return the field of all of them in uT, shape (N, 3)."""
        return field_of(self.shapes, points)


def field_of(shapes: Sequence[SourceShape], points: FloatArray) -> FloatArray:
    """Return the field of sources at points, shape (N, 3), in metres, in microtesla, (N, 3)."""
    return sum((each.field_and_gradient(points)[0] for each in shapes), np.zeros_like(points))


def nothing_found(rows: MarginalRows) -> FoundSources:
    """Return no sources."""
    left = rows.pull(rows.residual)[1]
    return FoundSources((), np.empty((0, 0)), np.empty(0), left, -left)


def price(rows: MarginalRows, parameters: int) -> float:
    """Return what a model of so many more parameters has to explain (Schwarz 1978)."""
    return parameters * float(np.log(3 * max(len(rows), 2)))


def refined(rows: MarginalRows, shapes: tuple[SourceShape, ...]) -> FoundSources:
    """Return the most likely sources near some, by damped Gauss-Newton steps."""
    if not shapes:
        return nothing_found(rows)
    free = np.concatenate([_free(each) for each in shapes])
    theta = np.concatenate([each.vector for each in shapes])
    prior = SourcePrior.of(len(shapes), float(np.median(rows.points[:, 2])), free)
    state = _State.at(rows, theta, free, prior)
    lengths = np.tile(~_is_in(MOMENT), len(shapes))[free]
    damping = 1e-3
    for _ in range(STEPS):
        F = state.information + damping * np.diag(np.diag(state.information))
        step = np.linalg.solve(F, state.gradient)
        long = np.abs(step[lengths]).max(initial=0.0)
        trial = theta.copy()
        trial[free] += step * min(1.0, LONGEST_M / max(long, LONGEST_M))
        after = _State.at(rows, trial, free, prior)
        if after.cost < state.cost:
            gained, state, theta = state.cost - after.cost, after, trial
            damping = max(damping / 5, 1e-9)
            if gained < SMALL_STEP:
                break
        else:
            damping *= 8
            if damping > 1e8:
                break
    root = np.zeros((len(theta), int(free.sum())))
    root[free] = _inverse_root(state.information)
    count = len(shapes)
    return FoundSources(
        tuple(SourceShape(each) for each in theta.reshape(count, PARAMETERS)),
        root,
        np.full(count, np.nan),
        state.cost,
        state.evidence,
    )


@dataclass(frozen=True)
class SourcePrior:
    """What is known of sources beforehand: mean and information of the free parameters, (P,)."""

    mean: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, count: int, height: float, free: BoolArray) -> "SourcePrior":
        """Return the prior of so many sources, where sensors are at a height in metres."""
        mean, information = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
        mean[2], information[2] = height + HEIGHT_M[0], HEIGHT_M[1] ** -2
        information[MOMENT] = MOMENT_AM2**-2
        information[HALF_AXIS] = HALF_LENGTH_M**-2
        return cls(np.tile(mean, count)[free], np.tile(information, count)[free])


@dataclass(frozen=True)
class _State:
    """Cost at some sources; a step that is refused needs no derivatives.

    Attributes
    ----------
    rows, shapes, free, prior
        What the cost is of.
    off
        What free parameters differ from their mean by, shape (P,).
    pulled
        Precision times residuals, shape (N, 3).
    cost
        Squared length of the white residuals, and of ``off``.
    """

    rows: MarginalRows
    shapes: list[SourceShape]
    free: BoolArray
    prior: "SourcePrior"
    off: FloatArray
    pulled: FloatArray
    cost: float

    @classmethod
    def at(
        cls, rows: MarginalRows, theta: FloatArray, free: BoolArray, prior: "SourcePrior"
    ) -> "_State":
        shapes = [SourceShape(each) for each in theta.reshape(-1, PARAMETERS)]
        pulled, squared = rows.pull(rows.residual - field_of(shapes, rows.points))
        off = theta[free] - prior.mean
        cost = squared + float(prior.information @ off**2)
        return cls(rows, shapes, free, prior, off, pulled, cost)

    @cached_property
    def _jacobian(self) -> FloatArray:
        every = [each.derivatives(self.rows.points) for each in self.shapes]
        return np.asarray(np.concatenate(every, axis=2)[:, :, self.free])

    @cached_property
    def gradient(self) -> FloatArray:
        """By the free parameters, downwards, shape (P,)."""
        pull = np.einsum("nim,ni->m", self._jacobian, self.pulled)
        return np.asarray(pull - self.prior.information * self.off)

    @cached_property
    def information(self) -> FloatArray:
        """Of the free parameters, shape (P, P)."""
        return self.rows.information(self._jacobian) + np.diag(self.prior.information)

    @property
    def evidence(self) -> float:
        """Of these sources, see `FoundSources`."""
        known = self.prior.information[self.prior.information > 0]  # of x and y nothing is
        narrower = float(np.linalg.slogdet(self.information)[1]) - float(np.log(known).sum())
        return -self.cost - narrower


def _free(shape: SourceShape) -> BoolArray:
    """Return which parameters of a source are open: a dipole has no length, a bar a direction."""
    return np.asarray(~_is_in(HALF_AXIS) | (shape.vector != 0))


def _is_in(part: slice) -> BoolArray:
    mask = np.zeros(PARAMETERS, dtype=np.bool_)
    mask[part] = True
    return mask


def _inverse_root(information: FloatArray) -> FloatArray:
    """Return a root of the inverse of an information matrix that may be nearly singular."""
    scale = 1 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * scale * scale[:, None]
    values, axes = np.linalg.eigh(scaled)
    return np.asarray(scale[:, None] * axes / np.sqrt(np.maximum(values, 1e-12)))

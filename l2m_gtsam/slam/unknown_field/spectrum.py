r"""Hyperparameters of a drive's field and noise, by the marginal likelihood of its readings.

Learnt together, for each is taken for another where it is not free: strength and length of the
field, size of the noise, which share of it is white and how long the rest lasts, and the distortion
C, H of the sensor. With readings b that the calibration has corrected, ``A b + h`` is the field at
the sensor, and

.. math::
    \log p(b) = \log N(A b + h; 0, F S F^T + T) + N \log |\det A|

with the weights of the waves F integrated out, T of white noise and an Ornstein-Uhlenbeck process,
and A and h by Laplace's approximation about the mode. ``log |det A|`` keeps A from shrinking all
readings to nothing.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import Bounds, minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.unknown_field.sensor_noise import AXES, SensorNoise, whiten

LEARNT_FROM = 300  # readings
MARGIN = 1.5  # of the box about the path, in lengths of the field: on its faces the field is normal
NEWTON, HALVINGS = 60, 20
SAME = 1e-7  # decrease of a cost that is none
EVALUATIONS = 200  # of the likelihood; a search takes 60 to 110
STEP, GAIN = 1e-3, 1e-4  # of the differences that are its slopes; share of it that is worth a step
# Logarithms of: strength in that of the readings, length in m, noise in the same strength, odds of
# white against slow noise, path of the latter in m. The likelihood has another mode, 100 to 200
# nats lower on the model ship, where an even field is read with slow noise: from either of these
# alone one search in ten ends there.
FIRST = np.array([[0.0, 0.0, -2.0, -2.0, -0.5], [0.0, -0.5, -2.0, -2.0, -1.0]])
LOWEST = np.array([-3.0, -1.2, -6.0, -7.0, -4.0])
HIGHEST = np.array([3.0, 3.0, 1.0, 7.0, 3.0])
LENGTH = 1  # which of them that is
SHORTEST_M, LONGEST_M = (float(np.exp(each[LENGTH])) for each in (LOWEST, HIGHEST))


@dataclass(frozen=True)
class LearntReadings:
    """N readings at an estimate of their places.

    Attributes
    ----------
    x, R
        Positions in metres (N, 3), rotations from the vehicle's axes (N, 3, 3).
    field
        Along the axes of the vehicle, corrected by the calibration, uT, shape (N, 3).
    path_m
        Path to them in metres in ascending order, shape (N,).
    """

    x: FloatArray
    R: FloatArray
    field: FloatArray
    path_m: FloatArray


@dataclass(frozen=True)
class FieldSpectrum:
    """What is learnt of a field and of the sensor that reads it.

    Attributes
    ----------
    prior
        Of the potential.
    noise
        Of the readings.
    correction
        A row by row and h in uT, with which ``A b + h`` is the field at the sensor where its
        calibration says b: the likeliest, shape (12,).
    log_likelihood
        Of the readings, but for constants.
    at
        Where the search ended, to begin another.
    """

    prior: PotentialHyperparameters
    noise: SensorNoise
    correction: FloatArray
    log_likelihood: float
    at: FloatArray


def learnt_spectrum(
    readings: LearntReadings,
    distortion: float,
    offset_ut: float,
    eigenfunctions: int,
    first: FieldSpectrum | None = None,
    shortest_m: float = SHORTEST_M,
) -> FieldSpectrum:
    """Return the hyperparameters of the largest marginal likelihood.

    Parameters
    ----------
    readings
        At an estimate of their places.
    distortion, offset_ut
        Standard deviations of what calibrations leave of C and, in uT, of H.
    eigenfunctions
        How many. What shorter ones would hold counts as noise.
    first
        Where to begin; absent, at both of ``FIRST``.
    shortest_m
        The field's length is no shorter, metres.
    """
    likelihood = SpectrumLikelihood(readings, distortion, offset_ut, eigenfunctions)
    lowest = np.where(np.arange(len(LOWEST)) == LENGTH, np.log(shortest_m), LOWEST)
    starts = FIRST if first is None else first.at[None]

    def cost(at: FloatArray) -> float:
        return -likelihood.log_likelihood(at)

    ends = [
        minimize(
            cost,
            np.maximum(start, lowest),
            method="L-BFGS-B",
            bounds=Bounds(lowest, HIGHEST),
            options={"eps": STEP, "ftol": GAIN, "maxfun": EVALUATIONS},
        )
        for start in starts
    ]
    end = min(ends, key=lambda each: float(each.fun))
    return FieldSpectrum(
        likelihood.prior(end.x),
        likelihood.noise(end.x),
        likelihood.correction(end.x),
        -float(end.fun),
        np.asarray(end.x),
    )


class SpectrumLikelihood:
    """The marginal likelihood of readings; parameters as of ``learnt_spectrum``."""

    def __init__(
        self, readings: LearntReadings, distortion: float, offset_ut: float, eigenfunctions: int
    ) -> None:
        x, b, self._count = readings.x, readings.field, len(readings.x)
        level = np.einsum("nij,nj->ni", readings.R, b)
        self._strength = float(np.sqrt(np.mean((level - level.mean(axis=0)) ** 2)))
        first = PotentialHyperparameters(sigma=self._strength, length=1.0)
        low, high = x.min(axis=0) - MARGIN, x.max(axis=0) + MARGIN
        self._basis = PotentialBasis.over(low, high, first, eigenfunctions)
        self._path_m = readings.path_m
        # Side by side, so that both are made white at once: features of the waves, and derivatives
        # of the corrected readings by A and h.
        waves = len(self._basis)
        self._columns = np.zeros((self._count, AXES, waves + 12))
        self._columns[:, :, :waves] = readings.R.transpose(0, 2, 1) @ self._basis.features(x)
        for axis in range(AXES):
            at = waves + 3 * axis
            self._columns[:, axis, at : at + 3] = b
            self._columns[:, axis, waves + 9 + axis] = 1.0
        self._mean = np.append(np.eye(AXES).ravel(), np.zeros(AXES))
        self._variance = np.repeat([distortion**2, offset_ut**2], [9, 3])

    def prior(self, at: FloatArray) -> PotentialHyperparameters:
        """Return the potential's covariance at logarithms of the hyperparameters."""
        strength, length = self._strength * np.exp(at[0]), np.exp(at[1])
        return PotentialHyperparameters(sigma=float(strength * length), length=float(length))

    def noise(self, at: FloatArray) -> SensorNoise:
        """Return the noise there."""
        white = 1 / (1 + np.exp(-at[3]))
        return SensorNoise(
            float(self._strength * np.exp(at[2])), float(white), float(np.exp(at[4]))
        )

    def correction(self, at: FloatArray) -> FloatArray:
        """Return the likeliest A, h there, shape (12,)."""
        information, _ = self._without_field(self.prior(at), self.noise(at))
        return self._likeliest(information)

    def log_likelihood(self, at: FloatArray) -> float:
        """Return the log likelihood there, but for constants."""
        return self.log_likelihood_of(self.prior(at), self.noise(at))

    def log_likelihood_of(self, prior: PotentialHyperparameters, noise: SensorNoise) -> float:
        """Return the log likelihood of a field and a noise, but for constants."""
        information, volume = self._without_field(prior, noise)
        return self._by_distortion(information) - volume

    def _without_field(
        self, prior: PotentialHyperparameters, noise: SensorNoise
    ) -> tuple[FloatArray, float]:
        """Return the information about A, h with the field integrated out, and its volume."""
        waves = len(self._basis)
        columns = self._columns.copy()
        columns[:, :, :waves] *= np.sqrt(self._basis.variances(prior))
        volume = AXES * whiten(noise, self._path_m, columns.reshape(self._count, -1))
        white = columns.reshape(AXES * self._count, -1)
        every = white.T @ white
        known, shared = np.eye(waves) + every[:waves, :waves], every[:waves, waves:]
        lower = cholesky(known, lower=True, check_finite=False)
        half = solve_triangular(lower, shared, lower=True, check_finite=False)
        volume += float(np.log(np.diag(lower)).sum())
        return every[waves:, waves:] - half.T @ half, volume

    def _by_distortion(self, information: FloatArray) -> float:
        """Return the log likelihood with A, h integrated out, of readings of this information."""
        a, own = self._likeliest(information), np.sqrt(self._variance)
        _, hessian = self._slopes(information, a)
        volume = float(np.linalg.slogdet(own[:, None] * hessian * own)[1])
        return -self._cost(information, a) - 0.5 * volume

    def _likeliest(self, information: FloatArray) -> FloatArray:
        """Return the mode of A, h that descent from the given calibration leads to.

        ``-log |det A|`` is concave along rotations of A, and the cost has valleys for sensors that
        are mounted otherwise. Newton's step would go up there, or far away: curvatures count by
        their size, and no entry moves by more than its standard deviation at once.
        """
        a, sigma = self._mean.copy(), np.sqrt(self._variance)
        cost = self._cost(information, a)
        for _ in range(NEWTON):
            gradient, hessian = self._slopes(information, a)
            curvature, axes = np.linalg.eigh(hessian)
            step = axes @ (axes.T @ gradient / np.abs(curvature))
            step /= max(1.0, float(np.abs(step / sigma).max()))
            lower = cost
            for halving in range(HALVINGS):
                trial = a - 0.5**halving * step
                if (at_trial := self._cost(information, trial)) <= cost:
                    a, lower = trial, at_trial
                    break
            if cost - lower < SAME:
                break
            cost = lower
        return a

    def _cost(self, information: FloatArray, a: FloatArray) -> float:
        sign, volume = np.linalg.slogdet(a[:9].reshape(3, 3))
        off = a - self._mean
        fit = 0.5 * (a @ information @ a + off @ (off / self._variance))
        return float(fit - self._count * volume) if sign > 0 else np.inf

    def _slopes(self, information: FloatArray, a: FloatArray) -> tuple[FloatArray, FloatArray]:
        # d log |det A| / dA = A^-T, and its derivative -A^-1_li A^-1_jk by A_ij and A_kl.
        back = np.linalg.inv(a[:9].reshape(3, 3))
        gradient = information @ a + (a - self._mean) / self._variance
        gradient[:9] -= self._count * back.T.ravel()
        hessian = information + np.diag(1 / self._variance)
        hessian[:9, :9] += self._count * np.einsum("li,jk->ijkl", back, back).reshape(9, 9)
        return gradient, hessian

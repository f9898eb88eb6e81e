r"""One field of floor and ceiling waves, and each sensor's noise, by the marginal likelihood.

With readings z of sensors whose calibrations say C and H, at an estimate of their poses,

.. math::
    z - H = C R^T F S w + J_s c_s + e, \quad w, c_s \sim N(0, I), \quad e \sim N(0, \sigma_s^2)

where S are the prior's standard deviations of the waves' weights, and ``J_s c_s`` is what a
calibration's own errors of C and H add, and a change of H since it was made, whose size is learnt,
too. Weights and errors are integrated out. With the covariance Sigma and the mean u of all of them,
the likelihood rises with the logarithm of a variance by ``(u_j^2 + Sigma_jj - 1) / 2``.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular
from scipy.optimize import Bounds, minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.modes import left_out
from l2m_gtsam.maps.harmonic.tiling import Resolution, TilingOptions
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.map_prediction import PlacedReadings
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.linear_field import AXES
from l2m_gtsam.slam.unknown_field.tiled_drive import TiledDrive
from l2m_gtsam.slam.unknown_field.tiles import level_axes, relative_place
from l2m_gtsam.slam.unknown_field.whole_field import WholeField, single_tile
from l2m_gtsam.solve.linear_algebra import covariance_root

MARGIN_M = TilingOptions().margin  # of the box about the readings
NAMES = ("floor_scale", "floor_depth", "ceiling_scale", "ceiling_depth")
# Of scales in uT, depths in m, and noise in uT. The field of nearer sources is that of one reading.
# At one height floor and ceiling are nearly the same waves: with stronger ones, or less noise,
# rounding would show in their information.
RANGES = ((1e-2, 300.0), (0.1, 30.0), (1e-2, 300.0), (0.1, 30.0))
NOISE_RANGE = (0.02, 30.0)
OFFSET_UT, OFFSET_RANGE = 1.0, (0.03, 30.0)  # change of a sensor's H: assumed at first, and sought
ITERATIONS = 40  # of the search; it takes 15 to 30
DISTORTION, OFFSETS = 12, 3  # numbers of C and H; of the change of H
OWN = DISTORTION + OFFSETS
LEAST_CUT, MOST_CUT, CUTS = 1.0, 40.0, 79  # rad/m, of waves that are kept
STRONGER, FACTORS = 4.0, 13  # than what counts as unheard; factors of it that are tried


@dataclass(frozen=True)
class WavePrior:
    """What is learnt of one field for a whole drive, and of the sensors that read it.

    Attributes
    ----------
    basis
        Waves in a level box about the readings, in the frame of the first key pose.
    hyperparameters
        Strength and depth of the sources; its noise is the mean of all sensors.
    noise
        Standard deviation of each sensor's readings per axis in uT, shape (S,).
    offset
        Of the change of each sensor's H per axis since its calibration, uT, shape (S,).
    sensors
        The likeliest (t, C row by row, H) of each at the poses, shape (S, 15); t as calibrated.
    log_likelihood
        Of the readings, but for constants.
    """

    basis: WaveBasis
    hyperparameters: Hyperparameters
    noise: FloatArray
    offset: FloatArray
    sensors: FloatArray
    log_likelihood: float

    @property
    def field(self) -> WholeField:
        """The field in the box."""
        scale = np.exp(0.5 * self.basis.prior(self.hyperparameters).log_variance)
        return WholeField(self.basis, scale)

    def divided(
        self, motions: RelativeMotions, poses: list[gtsam.Pose3], sensors: KnownSensors
    ) -> TiledDrive:
        """Return a drive as a single tile."""
        return single_tile(self.field, motions, poses, sensors)


def heard_waves(
    hyperparameters: Hyperparameters, frame: TileFrame, most: int, unheard: float
) -> Resolution | None:
    """Return which waves readings hear.

    Parameters
    ----------
    hyperparameters
        Strength and depth of the sources, and the noise of readings.
    frame
        Box of the waves.
    most
        Limit of waves: where more are heard, the weakest of both sides are left out.
    unheard
        All that are left out are together as strong as so many times the noise, or weaker.

    Returns
    -------
    The shortest that are kept; None where the limit leaves out such as are ``STRONGER`` than that.
    """
    edge = float(np.sqrt(np.prod(frame.size)))
    for times in unheard * np.geomspace(1.0, STRONGER, FACTORS):
        kept = waves_above(hyperparameters, float(times) * hyperparameters.noise)
        if kept.modes(edge) <= most:
            return kept
    return None


def waves_above(hyperparameters: Hyperparameters, strength: float) -> Resolution:
    """Return waves of which all shorter ones of a side together are weaker, per axis in uT."""
    cuts, h = np.linspace(LEAST_CUT, MOST_CUT, CUTS), hyperparameters
    kept = []
    for scale, depth in ((h.floor_scale, h.floor_depth), (h.ceiling_scale, h.ceiling_depth)):
        left = np.array([float(left_out(scale, depth, cut, np.zeros(1))[0]) for cut in cuts])
        heard = np.flatnonzero(left > strength**2)
        kept.append(float(cuts[min(heard[-1] + 1, CUTS - 1)]) if len(heard) else LEAST_CUT)
    return Resolution(*kept)


def box_about(drive: Drive, poses: list[gtsam.Pose3]) -> TileFrame:
    """Return a level box about the readings in the frame of the first key pose."""
    R = poses[0].rotation().matrix()
    up = R.T @ level_axes(R[None])[0]
    at = relative_place(drive.readings, poses, 0, drive.sensors).x @ up
    low, high = at.min(axis=0), at.max(axis=0)
    corner = np.array([low[0] - MARGIN_M, low[1] - MARGIN_M, low[2]])
    return TileFrame(up, up @ corner, (high - low)[:2] + 2 * MARGIN_M, float(high[2] - low[2]))


def learnt_waves(
    drive: Drive, poses: list[gtsam.Pose3], basis: WaveBasis, first: WavePrior | None = None
) -> WavePrior:
    """Return hyperparameters and noise of the largest marginal likelihood.

    Parameters
    ----------
    drive
        K key poses with readings of S sensors; its calibrations are integrated out.
    poses
        Estimates.
    basis
        Waves of the field.
    first
        Where to begin; absent, at the defaults and the noise of calibrations.
    """
    likelihood = WaveLikelihood(drive, poses, basis)
    known = Hyperparameters() if first is None else first.hyperparameters
    noise = drive.sensors.noise if first is None else first.noise
    offset = np.full(len(noise), OFFSET_UT) if first is None else first.offset
    begin = np.log([*(getattr(known, name) for name in NAMES), *noise, *offset])
    ranges = np.log([*RANGES, *[NOISE_RANGE] * len(noise), *[OFFSET_RANGE] * len(noise)])
    end = minimize(
        likelihood.cost_and_slopes,
        np.clip(begin, ranges[:, 0], ranges[:, 1]),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(ranges[:, 0], ranges[:, 1]),
        options={"maxiter": ITERATIONS},
    )
    _, own, change = np.split(np.exp(end.x), [len(NAMES), len(NAMES) + len(noise)])
    return WavePrior(
        basis=basis,
        hyperparameters=hyperparameters_at(end.x),
        noise=own,
        offset=change,
        sensors=likelihood.sensors(end.x),
        log_likelihood=-float(end.fun),
    )


def hyperparameters_at(at: FloatArray) -> Hyperparameters:
    """Return hyperparameters of logarithms: of those of waves, then of each sensor's others."""
    waves: Mapping[str, float] = dict(zip(NAMES, np.exp(at[: len(NAMES)]).tolist(), strict=True))
    noise, _ = np.split(np.exp(2 * at[len(NAMES) :]), 2)
    return Hyperparameters(**waves, noise=float(np.sqrt(noise.mean())))


class WaveLikelihood:
    """The marginal likelihood of readings; parameters as of ``learnt_waves``."""

    def __init__(self, drive: Drive, poses: list[gtsam.Pose3], basis: WaveBasis) -> None:
        sensors, self._basis, self._stated = drive.sensors, basis, drive.sensors
        self._roots = np.stack(
            [covariance_root(P, np.sqrt(np.diag(P))) for P in sensors.covariance[:, 3:, 3:]]
        )
        count, m = len(sensors.names), len(basis)
        size = m + OWN * count
        self._size, self._rows = size, np.zeros(count)
        self._grams, self._pulls = np.zeros((count, size, size)), np.zeros((count, size))
        self._squares = np.zeros(count)
        for k in range(count):
            rows = np.flatnonzero(drive.readings.sensor == k)
            where = relative_place(drive.readings[rows], poses, 0, sensors)
            columns, z = sensor_columns(where, sensors, k, self._roots[k], basis)
            at = np.r_[0:m, m + OWN * k : m + OWN * (k + 1)]
            self._grams[k][np.ix_(at, at)] = columns.T @ columns
            self._pulls[k, at] = columns.T @ z
            self._squares[k], self._rows[k] = z @ z, len(z)

    def cost_and_slopes(self, at: FloatArray) -> tuple[float, FloatArray]:
        """Return minus the log likelihood at logarithms, and its derivatives by these."""
        prior, m = self._basis.prior(hyperparameters_at(at)), len(self._basis)
        noise, _ = np.split(at[len(NAMES) :], 2)
        known, scale, found = np.exp(-2 * noise), self._scale(at), self._posterior(at)
        covariance = cho_solve((found.lower, True), np.eye(self._size), check_finite=False)
        cost = 0.5 * (known @ self._squares - found.explained)
        cost += np.log(np.diag(found.lower)).sum() + self._rows @ noise
        by_variance = 0.5 * (1 - np.diag(covariance) - found.mean**2)
        by_waves = [float(prior.slopes.get(name, np.zeros(m)) @ by_variance[:m]) for name in NAMES]
        by_offset = 2 * by_variance[m:].reshape(-1, OWN)[:, DISTORTION:].sum(axis=1)
        weights, spread = scale * found.mean, covariance * np.outer(scale, scale)
        left = self._squares - 2 * self._pulls @ weights
        left += np.einsum("kij,i,j->k", self._grams, weights, weights, optimize=True)
        left += np.tensordot(self._grams, spread, axes=2)
        return float(cost), np.concatenate([by_waves, self._rows - known * left, by_offset])

    def sensors(self, at: FloatArray) -> FloatArray:
        """Return the likeliest (t, C row by row, H) of each sensor at logarithms, (S, 15)."""
        own = (self._scale(at) * self._posterior(at).mean)[len(self._basis) :].reshape(-1, OWN)
        errors, change = np.hsplit(own, [DISTORTION])
        found = self._stated.vectors()
        found[:, 3:] += np.einsum("kij,kj->ki", self._roots, errors)
        found[:, 12:] += change
        return found

    def _scale(self, at: FloatArray) -> FloatArray:
        """Return the standard deviations of weights, errors and changes, shape (m + 15 S,)."""
        m, scale = len(self._basis), np.ones(self._size)
        scale[:m] = np.exp(0.5 * self._basis.prior(hyperparameters_at(at)).log_variance)
        _, offset = np.split(np.exp(at[len(NAMES) :]), 2)
        scale[m:].reshape(-1, OWN)[:, DISTORTION:] = offset[:, None]
        return scale

    def _posterior(self, at: FloatArray) -> "WavePosterior":
        noise, _ = np.split(at[len(NAMES) :], 2)
        known, scale = np.exp(-2 * noise), self._scale(at)
        information = np.tensordot(known, self._grams, axes=1) * np.outer(scale, scale)
        information[np.diag_indices(self._size)] += 1.0
        lower = cholesky(information, lower=True, check_finite=False)
        pulled = scale * (known @ self._pulls)
        half = solve_triangular(lower, pulled, lower=True, check_finite=False)
        mean = solve_triangular(lower, half, lower=True, trans="T", check_finite=False)
        return WavePosterior(lower, np.asarray(mean), float(half @ half))


@dataclass(frozen=True)
class WavePosterior:
    """Weights, errors and changes by all readings, in their standard deviations beforehand.

    Attributes
    ----------
    lower
        Cholesky factor of their information, shape (n, n).
    mean
        The likeliest, shape (n,).
    explained
        By how much they lower the sum of the readings' squares, whitened.
    """

    lower: FloatArray
    mean: FloatArray
    explained: float


def sensor_columns(
    where: PlacedReadings,
    sensors: KnownSensors,
    number: int,
    root: FloatArray,
    basis: WaveBasis,
) -> tuple[FloatArray, FloatArray]:
    """Return what a unit of each weight, and of each error of C and H, adds to readings.

    Parameters
    ----------
    where
        n readings of one sensor.
    sensors, number
        Calibrations, and which of them it is.
    root
        Of the covariance of its C and H, shape (12, 12).
    basis
        m waves.

    Returns
    -------
    columns
        Shape (3 n, m + 15): weights, errors of the calibration, the change of H.
    z
        The readings without H, shape (3 n,), uT.
    """
    n, m = len(where.x), len(basis)
    C = sensors.distortion[number, :9].reshape(AXES, AXES)
    H = sensors.distortion[number, 9:]
    z = where.readings.field - H
    columns, R = np.zeros((n, AXES, m + OWN)), where.readings.R_map_lidar
    columns[:, :, :m] = C @ R.transpose(0, 2, 1) @ basis.features(where.x)
    by_distortion = np.zeros((n, AXES, DISTORTION))
    b = np.linalg.solve(C, z.T).T
    for axis in range(AXES):
        by_distortion[:, axis, AXES * axis : AXES * (axis + 1)] = b
        by_distortion[:, axis, 9 + axis] = 1.0
    columns[:, :, m : m + DISTORTION] = by_distortion @ root
    columns[:, :, m + DISTORTION :] = np.eye(AXES)
    return columns.reshape(AXES * n, -1), z.ravel()

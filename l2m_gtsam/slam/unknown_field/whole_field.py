"""One field for a whole drive: a potential of reduced rank in a box about the path.

Tiles divide a drive through an area that is not much larger than the field's own scale into pieces
with too few readings each: of one sensor, a tile's waves follow the noise and errors of odometry,
and a return is seen by the readings of one tile alone. Here all readings determine the same
weights. The box is fixed to the first key pose.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import Bounds, minimize

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.map_prediction import place_readings
from l2m_gtsam.slam.options import WholeFieldOptions
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.linear_field import LinearField
from l2m_gtsam.slam.unknown_field.tiled_drive import OccupiedTile, TiledDrive, relative_place
from l2m_gtsam.slam.unknown_field.tiles import Anchoring

LEAST_WAVES = 50
CUT = 3.0  # waves shorter than the length over this count as noise
LEARNT_FROM, LEARNT_WITH = 800, 300  # readings and waves
MARGIN = 1.5  # of the box about the path, in lengths of the field: on its faces the field is normal


@dataclass(frozen=True)
class FieldSpectrum:
    """What is learnt of a field from readings at known places.

    Attributes
    ----------
    prior
        Of the potential.
    rest_ut
        Standard deviation per axis of what neither noise nor potential explains, uT.
    log_likelihood
        Of the readings, with the weights integrated out.
    """

    prior: PotentialHyperparameters
    rest_ut: float
    log_likelihood: float


@dataclass(frozen=True)
class WholeField(LinearField):
    """The field of a drive in the frame of its first key pose.

    Attributes
    ----------
    basis
        Eigenfunctions in the box.
    rest_ut
        Standard deviation per axis of what they do not hold, uT.
    """

    basis: PotentialBasis
    rest_ut: float

    def __len__(self) -> int:
        return len(self.basis)

    @property
    def scale(self) -> FloatArray:
        """Prior standard deviation of each weight, shape (m,)."""
        return np.asarray(np.sqrt(self.basis.variance))

    def features(self, points: FloatArray, /) -> FloatArray:
        """Return the field of weights of unit prior variance in uT, shape (N, 3, m)."""
        return self.basis.features(points) * self.scale

    def field_and_gradient(
        self, points: FloatArray, weights: FloatArray, /
    ) -> tuple[FloatArray, FloatArray]:
        """Return field (N, 3) in uT and gradient (N, 3, 3) in uT/m."""
        return self.basis.field_and_gradient(points, self.scale * weights)

    def unresolved(self, points: FloatArray) -> FloatArray:
        """Return the variance per axis of the rest, uT^2, shape (N, 3)."""
        return np.full((len(points), 3), self.rest_ut**2)


@dataclass(frozen=True)
class WholePrior:
    """The prior of one field for a whole drive.

    Attributes
    ----------
    spectrum
        What was learnt of the field.
    low, high
        Corners of the box in the frame of the first key pose in metres, shape (3,).
    waves
        Number of eigenfunctions.
    """

    spectrum: FieldSpectrum
    low: FloatArray
    high: FloatArray
    waves: int

    @property
    def field(self) -> WholeField:
        """The field in the box."""
        basis = PotentialBasis.over(self.low, self.high, self.spectrum.prior, self.waves)
        return WholeField(basis, self.spectrum.rest_ut)

    def divided(
        self, motions: RelativeMotions, poses: list[gtsam.Pose3], sensors: KnownSensors
    ) -> TiledDrive:
        """Return a drive as a single tile."""
        everything = np.arange(len(motions.readings))
        where = relative_place(motions.readings, poses, 0, sensors)
        tile = OccupiedTile(0, 0, everything, self.field, where)
        own = Anchoring(np.zeros(1, dtype=np.int64), np.zeros(len(poses), dtype=np.int64))
        return TiledDrive(own, (tile,))


def whole_prior(
    drive: Drive, poses: list[gtsam.Pose3], options: WholeFieldOptions, over_m: float = np.inf
) -> WholePrior | None:
    """Learn the prior of one field from a drive at an estimate of its poses.

    Parameters
    ----------
    drive
        K key poses with N readings.
    poses
        Their estimates.
    options
        Limit of eigenfunctions, and what steel on the vehicle may add to readings.
    over_m
        Path length from the start over which hyperparameters are learnt.

    Returns
    -------
    The prior; None where the field has more detail than so many eigenfunctions hold.
    """
    origin = poses[0]
    relative = {k: origin.between(pose) for k, pose in enumerate(poses)}
    where = place_readings(drive.readings, relative, drive.sensors)
    x, field = where.x, where.field(drive.sensors)
    noise = drive.sensors.noise[drive.readings.sensor]
    early = np.flatnonzero(drive.steps.path[drive.readings.key_pose] <= over_m)
    few = early[np.linspace(0, len(early) - 1, min(len(early), LEARNT_FROM)).round().astype(int)]
    spectrum = learnt_spectrum(
        x[few], field[few], noise[few], where.readings.R_map_lidar[few], options.offset
    )
    low, high, margin = x.min(axis=0), x.max(axis=0), MARGIN * spectrum.prior.length
    waves = waves_for(high - low + 2 * margin, spectrum.prior.length)
    if waves > options.waves:
        return None
    return WholePrior(spectrum, low - margin, high + margin, waves)


def waves_for(size: FloatArray, length: float) -> int:
    """Return how many eigenfunctions of a box hold most of a field's variance."""
    cut, a = CUT / length, np.pi / size
    axes = [np.arange(1, each + 1) for each in np.floor(cut / a).astype(int) + 1]
    squared = sum((n * each) ** 2 for n, each in zip(np.ix_(*axes), a, strict=True))
    return max(int(np.count_nonzero(squared <= cut**2)), LEAST_WAVES)


def learnt_spectrum(
    x: FloatArray, field: FloatArray, noise: FloatArray, R: FloatArray, offset_ut: float
) -> FieldSpectrum:
    """Return the hyperparameters of the largest marginal likelihood.

    Parameters
    ----------
    x, field
        N readings: places in metres and field in uT, shapes (N, 3).
    noise
        Standard deviation of each one's noise in uT, shape (N,).
    R
        Rotations from the vehicle's axes, shape (N, 3, 3).
    offset_ut
        Standard deviation per axis of the vehicle of what is added to all readings, uT.
    """
    strength = float(np.sqrt(np.mean((field - field.mean(axis=0)) ** 2)))
    first = PotentialHyperparameters(sigma=strength, length=1.0)
    basis = PotentialBasis.over(x.min(axis=0) - MARGIN, x.max(axis=0) + MARGIN, first, LEARNT_WITH)
    features = np.concatenate([basis.features(x), R], axis=2)
    F = (features / noise[:, None, None]).reshape(3 * len(x), -1)
    y = (field / noise[:, None]).ravel()
    sums = FieldSums(F.T @ F, F.T @ y, float(y @ y), len(y))

    def prior(log: FloatArray) -> PotentialHyperparameters:
        # The first is the strength of the field, sigma / length.
        return PotentialHyperparameters(
            sigma=float(np.exp(log[0] + log[1])), length=float(np.exp(log[1]))
        )

    def cost(log: FloatArray) -> float:
        variance = np.append(basis.variances(prior(log)), np.full(3, offset_ut**2))
        return -sums.log_likelihood(variance, float(np.exp(log[2])))

    lowest, highest = np.log([0.05 * strength, 0.3, 1.0]), np.log([20 * strength, 20.0, 1e4])
    start = np.log([strength, 1.0, 2.0])
    end = minimize(
        cost,
        start,
        method="Nelder-Mead",
        bounds=Bounds(lowest, highest),
        options={
            "xatol": 0.02,
            "fatol": 0.2,
            "initial_simplex": start + np.vstack([np.zeros(3), 0.5 * np.eye(3)]),
        },
    )
    rest = float(noise.mean() * np.sqrt(np.expm1(max(end.x[2], 0.0))))
    constant = np.log(noise).sum() * 3
    return FieldSpectrum(prior(end.x), rest, -float(end.fun + constant))


@dataclass(frozen=True)
class FieldSums:
    """What a likelihood needs of N values that are whitened by their noise.

    Attributes
    ----------
    FF, Fy, yy
        Products of features and values, shapes (m, m) and (m,).
    rows
        N.
    """

    FF: FloatArray
    Fy: FloatArray
    yy: float
    rows: int

    def log_likelihood(self, variance: FloatArray, share: float) -> float:
        """Return the log density but for constants, with the weights integrated out.

        Parameters
        ----------
        variance
            Prior variance of the weights, shape (m,).
        share
            Factor of the variance of the noise.
        """
        scale = np.sqrt(variance / share)
        lower = cholesky(np.eye(len(scale)) + scale[:, None] * self.FF * scale, lower=True)
        half = solve_triangular(lower, scale * self.Fy, lower=True)
        fit = 0.5 * (self.yy - half @ half) / share
        return float(-fit - np.log(np.diag(lower)).sum() - 0.5 * self.rows * np.log(share))

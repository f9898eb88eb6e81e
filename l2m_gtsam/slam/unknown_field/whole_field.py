"""One field for a whole drive: a potential of reduced rank in a box about the path.

Tiles divide a drive through an area that is not much larger than the field's own scale into pieces
with too few readings each: of one sensor, a tile's waves follow the noise and errors of odometry,
and a return is seen by the readings of one tile alone. Here all readings determine the same
weights. The box is fixed to the first key pose.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.potential import PotentialBasis
from l2m_gtsam.slam.drive import Drive, KnownSensors
from l2m_gtsam.slam.options import WholeFieldOptions
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.unknown_field.linear_field import LinearField
from l2m_gtsam.slam.unknown_field.spectrum import (
    LEARNT_FROM,
    LONGEST_M,
    MARGIN,
    SHORTEST_M,
    FieldSpectrum,
    LearntReadings,
    SpectrumLikelihood,
    learnt_spectrum,
)
from l2m_gtsam.slam.unknown_field.tiled_drive import OccupiedTile, TiledDrive
from l2m_gtsam.slam.unknown_field.tiles import Anchoring, relative_place

LEAST_WAVES = 50
# In the logarithm of the likelihood, of which five parameters are learnt: more is no chance.
CLEAR = 10.0
LONGER = 1.05  # lengths are tried that are so many times the one before
COMPARED_BY = 3000  # readings, of which features of a fine field take 44 MB


@dataclass(frozen=True)
class FieldDetail:
    """How much of a field's detail counts as field; the rest counts as noise.

    Attributes
    ----------
    learnt_with
        Eigenfunctions by which strength, length and noise are learnt.
    cut
        Eigenfunctions count whose wave number is less than this over the field's length.
    """

    learnt_with: int
    cut: float


# A tenth of a field's variance is beyond 3 over its length, and a hundredth beyond 4. At poses that
# are off by as much as short waves are long, these lead astray; at good poses, what they are not
# there to explain counts as noise that fits better where poses are wrong.
COARSE, FINE = FieldDetail(200, 3.0), FieldDetail(600, 4.0)


@dataclass(frozen=True)
class WholeField(LinearField):
    """The field of a drive in the frame of its first key pose, of waves in a box."""

    basis: PotentialBasis | WaveBasis

    @classmethod
    def of(cls, basis: PotentialBasis) -> "WholeField":
        """Return the field of eigenfunctions, whose weights have the variances that these state."""
        return cls(basis, np.sqrt(basis.variance))

    def by_points(self, points: FloatArray, by_features: FloatArray) -> FloatArray:
        """Return the derivative of a scalar by points (N, 3), of one by features (N, 3, m)."""
        return self.basis.by_points(points, by_features * self.scale)

    def penalised(self, lower: FloatArray) -> FloatArray:
        """Return the covariance's root: the volume of weights, whose prior is the one learnt.

        Poses go to the mode of their own density then, with the field integrated out.
        """
        return np.asarray(solve_triangular(lower, np.eye(len(lower)), lower=True).T)

    @property
    def half_wave(self) -> float:
        """0: what its waves do not hold is learnt with the noise."""
        return 0.0

    def unresolved(self, points: FloatArray) -> FloatArray:
        """Return none, shape (N, 3): what they do not hold is learnt with the noise."""
        return np.zeros((len(points), 3))

    def unresolved_together(self, points: FloatArray) -> FloatArray:
        """Return none, shape (N, 3)."""
        return self.unresolved(points)


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
        return WholeField.of(basis)

    def capped(self, most: int) -> "WholePrior":
        """Return it with so many eigenfunctions at most: what shorter waves hold is noise."""
        return replace(self, waves=min(self.waves, most))

    def divided(
        self, motions: RelativeMotions, poses: list[gtsam.Pose3], sensors: KnownSensors
    ) -> TiledDrive:
        """Return a drive as a single tile."""
        return single_tile(self.field, motions, poses, sensors)


def single_tile(
    field: WholeField, motions: RelativeMotions, poses: list[gtsam.Pose3], sensors: KnownSensors
) -> TiledDrive:
    """Return a drive as a single tile with such a field."""
    everything = np.arange(len(motions.readings))
    where = relative_place(motions.readings, poses, 0, sensors)
    tile = OccupiedTile(0, 0, everything, field, where)
    own = Anchoring(np.zeros(1, dtype=np.int64), np.zeros(len(poses), dtype=np.int64))
    return TiledDrive(own, (tile,), np.zeros_like(motions.readings.field))


def learnt_prior(
    drive: Drive,
    poses: list[gtsam.Pose3],
    options: WholeFieldOptions,
    first: FieldSpectrum | None = None,
) -> WholePrior | None:
    """Learn the prior of one coarse field from a drive at an estimate of its poses.

    Parameters
    ----------
    drive
        K key poses with N readings of one sensor.
    poses
        Their estimates.
    options
        Limit of eigenfunctions, and what steel on the vehicle may add to readings.
    first
        What was learnt at another estimate.

    Returns
    -------
    The prior; None where the field has more detail than so many eigenfunctions hold.
    """
    spectrum = spectrum_at(drive, poses, options, COARSE, first)
    prior = prior_about(drive, poses, options, spectrum)
    if prior is not None:
        return prior
    # A search may end at a field of short waves that nothing speaks for.
    least = shortest_held(drive, poses, options.waves, spectrum)
    if least is None:
        return None
    longer = spectrum_at(drive, poses, options, COARSE, first, least)
    if longer.log_likelihood < spectrum.log_likelihood - CLEAR:
        return None
    return prior_about(drive, poses, options, longer)


def shortest_held(
    drive: Drive, poses: list[gtsam.Pose3], waves: int, spectrum: FieldSpectrum
) -> float | None:
    """Return the shortest length in metres of a coarse field that so many eigenfunctions hold.

    Other parameters as of ``learnt_prior``; ``spectrum`` is of a field of shorter length. None
    where the longest that is learnt is too short for the box, too.
    """

    def held(length: float) -> bool:
        prior = spectrum.prior.model_copy(update={"length": length})
        return full_prior(drive, poses, replace(spectrum, prior=prior), COARSE).waves <= waves

    length = LONGER * spectrum.prior.length
    while length < LONGEST_M and not held(length):
        length *= LONGER
    return length if length < LONGEST_M else None


def fine_prior(
    drive: Drive,
    poses: list[gtsam.Pose3],
    options: WholeFieldOptions,
    first: FieldSpectrum | None = None,
) -> WholePrior:
    """Learn the prior of a fine field, for good poses; parameters as of ``learnt_prior``."""
    spectrum = spectrum_at(drive, poses, options, FINE, first)
    return full_prior(drive, poses, spectrum, FINE).capped(options.waves)


def spectrum_at(
    drive: Drive,
    poses: list[gtsam.Pose3],
    options: WholeFieldOptions,
    detail: FieldDetail,
    first: FieldSpectrum | None = None,
    shortest_m: float = SHORTEST_M,
) -> FieldSpectrum:
    """Learn what field and noise are like at an estimate of the poses.

    The field's length is ``shortest_m`` at least; other parameters as of ``learnt_prior``.
    """
    readings = readings_at(drive, poses, LEARNT_FROM)
    distortion, offset = options.distortion, options.offset
    return learnt_spectrum(readings, distortion, offset, detail.learnt_with, first, shortest_m)


def log_likelihood_at(
    drive: Drive, poses: list[gtsam.Pose3], options: WholeFieldOptions, spectrum: FieldSpectrum
) -> float:
    """Return how likely a drive's readings are at an estimate of its poses, but for constants.

    A fine field, and what C and H of the sensor are wrong by, are integrated out; parameters as of
    ``learnt_prior``.
    """
    readings = readings_at(drive, poses, COMPARED_BY)
    distortion, offset = options.distortion, options.offset
    likelihood = SpectrumLikelihood(readings, distortion, offset, FINE.learnt_with)
    return likelihood.log_likelihood_of(spectrum.prior, spectrum.noise)


def readings_at(drive: Drive, poses: list[gtsam.Pose3], most: int) -> LearntReadings:
    """Return readings of a drive at an estimate of its poses, so many at most."""
    where = relative_place(drive.readings, poses, 0, drive.sensors)
    x, R = where.x, where.readings.R_map_lidar
    few = np.linspace(0, len(x) - 1, min(len(x), most)).round().astype(int)
    corrected = np.einsum("nji,nj->ni", R, where.field(drive.sensors))
    return LearntReadings(x[few], R[few], corrected[few], drive.progress_at_readings[few])


def prior_about(
    drive: Drive, poses: list[gtsam.Pose3], options: WholeFieldOptions, spectrum: FieldSpectrum
) -> WholePrior | None:
    """Return the prior of a coarse field about an estimate of the poses, learnt at another.

    Parameters and result as of ``learnt_prior``.
    """
    prior = full_prior(drive, poses, spectrum, COARSE)
    return prior if prior.waves <= options.waves else None


def full_prior(
    drive: Drive, poses: list[gtsam.Pose3], spectrum: FieldSpectrum, detail: FieldDetail
) -> WholePrior:
    """Return the prior in a box about the poses with all waves that the field needs."""
    x = relative_place(drive.readings, poses, 0, drive.sensors).x
    margin = MARGIN * spectrum.prior.length
    low, high = x.min(axis=0) - margin, x.max(axis=0) + margin
    waves = waves_for(high - low, detail.cut / spectrum.prior.length)
    return WholePrior(spectrum, low, high, waves)


def waves_for(size: FloatArray, cut: float) -> int:
    """Return how many eigenfunctions of a box have a wave number below a cut, rad/m."""
    a = np.pi / size
    axes = [np.arange(1, each + 1) for each in np.floor(cut / a).astype(int) + 1]
    squared = sum((n * each) ** 2 for n, each in zip(np.ix_(*axes), a, strict=True))
    return max(int(np.count_nonzero(squared <= cut**2)), LEAST_WAVES)

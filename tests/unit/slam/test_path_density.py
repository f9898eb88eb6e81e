"""The density of readings on a path, with field and noise integrated out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.harmonic.basis import WaveBasis
from l2m_gtsam.maps.harmonic.family import Hyperparameters
from l2m_gtsam.maps.harmonic.frame import TileFrame
from l2m_gtsam.maps.harmonic.tiling import Resolution
from l2m_gtsam.maps.potential import PotentialBasis, PotentialHyperparameters
from l2m_gtsam.slam.unknown_field.path_density import InverseNoise, PathDensity, PathReadings
from l2m_gtsam.slam.unknown_field.sensor_noise import (
    NoiseInformation,
    SensorNoise,
    WhiteInformation,
)
from l2m_gtsam.slam.unknown_field.whole_field import WholeField

COUNT, STEP = 25, 1e-5
NOISE = SensorNoise(0.8, 0.2, 1.5)
PATH_M = np.cumsum(np.random.default_rng(8).uniform(0.1, 0.9, COUNT))
WEIGHTS = np.random.default_rng(9).uniform(0.2, 1.0, COUNT)
PRIOR = PotentialHyperparameters(sigma=4.0, length=0.7)


def noise_covariance() -> FloatArray:
    """Along one axis, by its definition."""
    alike = np.exp(-np.abs(np.subtract.outer(PATH_M, PATH_M)) / NOISE.slow_m)
    return np.asarray(NOISE.slow_ut**2 * alike + np.diag(NOISE.white_ut**2 / WEIGHTS))


def along_a_path(waves: int = 60, margin: float = 1.0) -> tuple[PathReadings, WholeField]:
    rng = np.random.default_rng(3)
    p = np.column_stack([np.linspace(0, 2, COUNT), rng.normal(0, 0.2, (COUNT, 2))])
    R = Rotation.from_rotvec(rng.normal(0, 0.6, (COUNT, 3))).as_matrix()
    low, high = p.min(axis=0) - margin, p.max(axis=0) + margin
    field = WholeField.of(PotentialBasis.over(low, high, PRIOR, waves))
    b = np.einsum("nji,nj->ni", R, field.features(p) @ rng.normal(size=len(field)))
    own = np.zeros(COUNT, dtype=np.int64)
    return PathReadings(R, p, b + rng.normal(size=b.shape), own), field


def sensor() -> FloatArray:
    rng = np.random.default_rng(4)
    C = np.eye(3) + rng.normal(0, 0.1, (3, 3))
    return np.concatenate([rng.normal(0, 0.2, 3), C.ravel(), rng.normal(0, 2, 3)])


def density(readings: PathReadings, field: WholeField) -> PathDensity:
    return PathDensity(readings, field, NoiseInformation(NOISE, PATH_M, WEIGHTS))


def test_the_noise_has_the_inverse_of_its_covariance() -> None:
    found = NoiseInformation(NOISE, PATH_M, WEIGHTS)(np.eye(COUNT))
    np.testing.assert_allclose(found @ noise_covariance(), np.eye(COUNT), atol=1e-9)


def test_the_cost_is_that_of_a_normal_density() -> None:
    """Differences between sensors are those of the density by its definition."""
    readings, field = along_a_path()
    one, other = np.append(np.zeros(3), [*np.eye(3).ravel(), 0, 0, 0]), sensor()

    def by_definition(at: FloatArray) -> float:
        x = readings.p + readings.R @ at[:3]
        F = at[3:12].reshape(3, 3) @ readings.R.transpose(0, 2, 1) @ field.features(x)
        flat = F.reshape(3 * COUNT, -1)
        K = flat @ flat.T + np.kron(noise_covariance(), np.eye(3))
        off = (readings.z - at[12:]).ravel()
        return -float(multivariate_normal(np.zeros(len(K)), K).logpdf(off))

    still, cost = np.zeros((COUNT, 6)), density(readings, field)
    found = cost.slopes(still, other[None]).cost - cost.slopes(still, one[None]).cost
    assert found == pytest.approx(by_definition(other) - by_definition(one), abs=1e-6)


def of_floor_and_ceiling(readings: PathReadings) -> WholeField:
    """Return a field of waves in a box about a path that is turned and tilted against it."""
    axes = Rotation.from_rotvec([0.1, -0.05, 0.7]).as_matrix()
    local = readings.p @ axes
    low, high = local.min(axis=0) - 0.5, local.max(axis=0) + 0.5
    frame = TileFrame(axes, axes @ low, (high - low)[:2], float((high - low)[2]))
    basis = WaveBasis.over(frame, Resolution(6.0, 4.0))
    scale = np.exp(0.5 * basis.prior(Hyperparameters()).log_variance)
    return WholeField(basis, scale)


@pytest.mark.parametrize("floor", [False, True], ids=["potential", "floor and ceiling"])
@pytest.mark.parametrize("several", [False, True], ids=["one sensor", "two sensors"])
def test_slopes_are_those_of_the_cost(*, floor: bool, several: bool) -> None:
    """Against central differences, at the estimate and a little beside it."""
    readings, field = along_a_path()
    at = sensor()[None]
    noise: InverseNoise = NoiseInformation(NOISE, PATH_M, WEIGHTS)
    if several:
        other = sensor() + np.random.default_rng(1).normal(0, 0.05, 15)
        readings = replace(readings, sensor=np.arange(COUNT) % 2)
        at, noise = np.stack([at[0], other]), WhiteInformation(0.25 / WEIGHTS)
    if floor:
        field = of_floor_and_ceiling(readings)
    rng, cost = np.random.default_rng(5), PathDensity(readings, field, noise)
    for moved in (np.zeros((COUNT, 6)), 1e-4 * rng.normal(size=(COUNT, 6))):
        slopes = cost.slopes(moved, at)
        for _ in range(6):
            v, s = rng.normal(size=(COUNT, 6)), rng.normal(size=at.shape)
            ends = [
                cost.slopes(moved + by * STEP * v, at + by * STEP * s).cost for by in (1.0, -1.0)
            ]
            along = float(np.sum(slopes.by_path * v) + np.sum(slopes.by_sensor * s))
            # Rounding of the cost, 1e-12 of it, over the step; and turns of 1e-4 squared.
            assert (ends[0] - ends[1]) / (2 * STEP) == pytest.approx(along, rel=1e-5, abs=1e-3)


def test_a_path_that_moves_as_a_whole_is_as_likely() -> None:
    """Waves are stationary but for the faces of their box: a shift by 0.3 lengths of the field."""
    readings, field = along_a_path(waves=900, margin=1.5)
    at = np.append(np.zeros(3), [*np.eye(3).ravel(), 0, 0, 0])[None]
    cost = density(readings, field)
    still = np.zeros((COUNT, 6))
    before = cost.slopes(still, at).cost
    along = np.einsum("nji,j->ni", readings.R, np.array([0.2, 0.0, 0.0]))
    together = cost.slopes(np.hstack([still[:, :3], along]), at).cost
    half = along * (np.arange(COUNT) < COUNT // 2)[:, None]
    apart = cost.slopes(np.hstack([still[:, :3], half]), at).cost
    assert abs(together - before) < 0.5  # nats
    assert apart > before + 5  # the path is torn by 0.2 m


def test_slopes_by_points_are_those_of_the_features() -> None:
    readings, field = along_a_path()
    assert isinstance(field.basis, PotentialBasis)
    by = np.random.default_rng(6).normal(size=(COUNT, 3, len(field)))
    slopes = field.basis.slopes(readings.p) * field.scale
    expected = np.einsum("nam,nacm->nc", by, slopes)
    np.testing.assert_allclose(field.by_points(readings.p, by), expected, rtol=1e-10)


def test_slopes_by_points_of_floor_and_ceiling_are_those_of_the_features() -> None:
    readings, _ = along_a_path()
    field = of_floor_and_ceiling(readings)
    by = np.random.default_rng(6).normal(size=(COUNT, 3, len(field)))
    steps = STEP * np.eye(3)
    ends = [
        np.einsum("nam,nam->n", by, field.features(readings.p + step)) for step in (*steps, *-steps)
    ]
    expected = (np.stack(ends[:3], axis=1) - np.stack(ends[3:], axis=1)) / (2 * STEP)
    scale = np.abs(expected).max()  # the third difference: (STEP k)^2 / 6 of a wave's slope
    np.testing.assert_allclose(field.by_points(readings.p, by), expected, atol=1e-7 * scale)


def test_the_likeliest_weights_follow_path_and_sensor() -> None:
    """Against ridge solutions by definition on paths and sensors beside the estimate."""
    readings, field = along_a_path()
    at, rng, quiet = sensor(), np.random.default_rng(6), NOISE.scaled(0.01)
    noise = np.kron(1e-4 * noise_covariance(), np.eye(3))

    def features(moved: FloatArray, s: FloatArray) -> FloatArray:
        R = readings.R @ Rotation.from_rotvec(moved[:, :3]).as_matrix()
        x = readings.p + np.einsum("nij,nj->ni", readings.R, moved[:, 3:]) + R @ s[:3]
        own = s[3:12].reshape(3, 3) @ R.transpose(0, 2, 1) @ field.features(x)
        return np.asarray(own.reshape(3 * COUNT, -1))

    still = np.zeros((COUNT, 6))
    # Readings that the field explains, so that the product of residuals and slopes is small.
    z = (features(still, at) @ rng.normal(size=len(field))).reshape(-1, 3) + at[12:]

    def likeliest(moved: FloatArray, s: FloatArray) -> FloatArray:
        F, y = features(moved, s), (z - s[12:]).ravel()
        white = np.linalg.solve(noise, np.column_stack([F, y]))
        information = np.eye(len(field)) + F.T @ white[:, :-1]
        return np.asarray(np.linalg.solve(information, F.T @ white[:, -1]))

    own = PathDensity(replace(readings, z=z), field, NoiseInformation(quiet, PATH_M, WEIGHTS))
    found = own.weights(likeliest(still, at), at)
    F = features(still, at)
    information = np.eye(len(field)) + F.T @ np.linalg.solve(noise, F)
    np.testing.assert_allclose(found.covariance @ information, np.eye(len(field)), atol=1e-6)
    for _ in range(4):
        v, s = rng.normal(size=(COUNT, 6)), rng.normal(size=15)
        ends = [likeliest(by * STEP * v, at + by * STEP * s) for by in (1.0, -1.0)]
        slope = np.einsum("mnp,np->m", found.by_path, v) + found.by_sensor @ s
        # What the prior leaves of the readings, a thousandth, times slopes of its directions.
        expected = (ends[0] - ends[1]) / (2 * STEP)
        assert np.linalg.norm(slope - expected) < 0.02 * np.linalg.norm(expected)

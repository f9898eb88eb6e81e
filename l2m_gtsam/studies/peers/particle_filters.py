"""Two particle filters: magnetic SLAM, and localisation in a known map.

In SLAM (M. Kok and A. Solin, FUSION 2018) each particle has a path and a Kalman filter of the
weights of a potential field in a box, as the filter of
:mod:`l2m_gtsam.studies.peers.reduced_rank_ekf` has them. A particle weighs as much as it predicted
the readings.

In a known map (A. Solin et al., ENC 2016) particles follow odometry with its drift. Each weighs as
much as it predicts the strength of the field at the sensors: strength does not depend on the
attitude, so that calibrated sensors of any orientation take part alike.

In both, where few particles carry the weight, they are drawn anew.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.options import Options
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.options import DriftOptions
from l2m_gtsam.studies.peers.reduced_rank_ekf import POSE, ReducedRankEkfOptions

AXES = 3


class ParticleSlamOptions(Options):
    """Parameters of the particle filter beside those of the field, the noise and the steps."""

    particles: int = Field(default=200, ge=2)
    """Paths with a map each."""
    effective: float = Field(default=0.5, gt=0, le=1)
    """Share of particles with weight, below which they are drawn anew."""


def particle_slam(
    odometry: Trajectory,
    field: FloatArray,
    box: FloatArray,
    model: ReducedRankEkfOptions,
    options: ParticleSlamOptions,
    seed: int,
) -> Trajectory:
    """Return mean and covariance of the particles at each reading, from the readings until then.

    Parameters
    ----------
    odometry
        N poses, one for each reading. The first is the start, which is exact.
    field
        Readings along the axes of the vehicle in uT, shape (N, 3).
    box
        Lower and upper corner of the path in metres, shape (2, 3).
    model
        Field, noise and errors of steps.
    options
        Parameters of the particle filter.
    seed
        Of its draws.
    """
    rng, count = np.random.default_rng(seed), options.particles
    basis = model.basis_about(box)
    weights = np.zeros((count, len(basis)))
    P = np.broadcast_to(np.diag(basis.variance), (count, len(basis), len(basis))).copy()
    p = np.broadcast_to(odometry.p[0], (count, AXES)).copy()
    R = np.broadcast_to(odometry.R[0], (count, AXES, AXES)).copy()
    logs = np.zeros(count)
    level, turn = model.level_variance, model.turn_variance
    step_sigma = np.sqrt([level, level, model.vertical_variance])
    steps = np.diff(odometry.p, axis=0)
    turns = odometry.R[1:] @ odometry.R[:-1].transpose(0, 2, 1)
    noise = model.noise_ut**2 * np.eye(AXES)
    own = np.diag([turn] * AXES + (step_sigma**2).tolist())
    found = [(odometry.R[0], odometry.p[0], np.zeros((POSE, POSE)))]
    for step, turned, reading in zip(steps, turns, field[1:], strict=True):
        p += step + step_sigma * rng.normal(size=p.shape)
        off = np.sqrt(turn) * rng.normal(size=p.shape)
        R = Rotation.from_rotvec(off).as_matrix() @ turned @ R
        F = basis.features(p)
        left = R @ reading - np.einsum("kij,kj->ki", F, weights)
        across = P @ F.transpose(0, 2, 1)
        S = F @ across + noise
        solved = np.linalg.solve(S, np.concatenate([left[:, :, None], F @ P], axis=2))
        logs -= 0.5 * (np.einsum("ki,ki->k", left, solved[:, :, 0]) + np.linalg.slogdet(S)[1])
        weights += np.einsum("kmi,ki->km", across, solved[:, :, 0])
        P -= across @ solved[:, :, 1:]
        shares = np.exp(logs - logs.max())
        shares /= shares.sum()
        found.append(moments(R, p, shares, own))
        if 1 / np.sum(shares**2) < options.effective * count:
            drawn = systematic(shares, rng)
            R, p, weights, P, logs = R[drawn], p[drawn], weights[drawn], P[drawn], np.zeros(count)
    return path_of(odometry, found)


def moments(
    R: FloatArray, p: FloatArray, shares: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean rotation, mean position and covariance of weighted poses.

    Parameters
    ----------
    R, p
        Of K particles, shapes (K, 3, 3) and (K, 3).
    shares
        Their weights, which sum to one, shape (K,).
    own
        Covariance (rotation, position) of a step: no particle stands for less, shape (6, 6).
    """
    mean_R = Rotation.from_matrix(R).mean(shares).as_matrix()
    mean_p = shares @ p
    turn = Rotation.from_matrix(mean_R.T @ R).as_rotvec()
    off = np.hstack([turn, (p - mean_p) @ mean_R])
    return mean_R, mean_p, (off * shares[:, None]).T @ off + own


def path_of(
    odometry: Trajectory, found: Sequence[tuple[FloatArray, FloatArray, FloatArray]]
) -> Trajectory:
    """Return rotations, positions and covariances at the times of odometry."""
    R, p, covariance = (np.stack(each) for each in zip(*found, strict=True))
    return replace(odometry, R=R, p=p, covariance=covariance)


def systematic(shares: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return indices drawn as often as shares say, by one draw at even distances, shape (K,)."""
    count = len(shares)
    at = (rng.uniform() + np.arange(count)) / count
    return np.minimum(np.searchsorted(np.cumsum(shares), at), count - 1)


class MapParticlesOptions(Options):
    """Parameters of the filter."""

    particles: int = Field(default=500, ge=2)
    """How many."""
    effective: float = Field(default=0.5, gt=0, le=1)
    """Share of particles with weight, below which they are drawn anew."""
    noise_ut: float = Field(default=1.0, gt=0)
    """Standard deviation of a strength against the map, map's errors included, uT."""


def map_particles(
    odometry: Trajectory,
    strength: FloatArray,
    t_lidar_mag: FloatArray,
    field_map: QueryableMap,
    drift: DriftOptions,
    options: MapParticlesOptions,
    seed: int,
) -> Trajectory:
    """Return mean and covariance of the particles at each pose, from the readings until then.

    Parameters
    ----------
    odometry
        N poses. The first is the start, which is exact.
    strength
        Of the field at S sensors at these poses in uT, shape (N, S); NaN where there is none.
    t_lidar_mag
        Positions of the sensors in metres, shape (S, 3).
    field_map
        Map of the field.
    drift
        Of odometry.
    options
        Parameters of the filter.
    seed
        Of its draws.
    """
    rng, count = np.random.default_rng(seed), options.particles
    back = odometry.R[:-1].transpose(0, 2, 1)
    turns = back @ odometry.R[1:]
    steps = np.einsum("nij,nj->ni", back, np.diff(odometry.p, axis=0))
    covariance = drift_covariance(turns, steps, drift, odometry.R[1:, 2])
    roots = np.linalg.cholesky(covariance)
    p = np.tile(odometry.p[0], (count, 1))
    R = np.tile(odometry.R[0], (count, 1, 1))
    logs = np.zeros(count)
    found = [(odometry.R[0], odometry.p[0], np.zeros((POSE, POSE)))]
    for k, (turn, step) in enumerate(zip(turns, steps, strict=True)):
        off = rng.normal(size=(count, POSE)) @ roots[k].T
        p = p + R @ step
        R = R @ turn
        p = p + np.einsum("kij,kj->ki", R, off[:, AXES:])
        R = R @ Rotation.from_rotvec(off[:, :AXES]).as_matrix()
        seen = np.flatnonzero(np.isfinite(strength[k + 1]))
        if len(seen):
            at = p[:, None] + np.einsum("kij,sj->ksi", R, t_lidar_mag[seen])
            field, _ = field_map.field_and_gradient(at.reshape(-1, AXES))
            expected = np.linalg.norm(field, axis=1).reshape(count, len(seen))
            left = (strength[k + 1, seen] - expected) / options.noise_ut
            logs = logs - 0.5 * np.sum(left**2, axis=1)
        shares = np.exp(logs - logs.max())
        shares /= shares.sum()
        found.append(moments(R, p, shares, covariance[k]))
        if 1 / np.sum(shares**2) < options.effective * count:
            drawn = systematic(shares, rng)
            R, p, logs = R[drawn], p[drawn], np.zeros(count)
    return path_of(odometry, found)

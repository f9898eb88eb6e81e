"""Magnetic SLAM by a Rao-Blackwellised particle filter, after M. Kok and A. Solin (FUSION 2018).

Each particle has a path and a Kalman filter of the weights of a potential field in a box, as the
filter of :mod:`l2m_gtsam.studies.peers.reduced_rank_ekf` has them. A particle weighs as much as it
predicted the readings; where few of them carry the weight, they are drawn anew.
"""

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.options import Options
from l2m_gtsam.studies.peers.reduced_rank_ekf import POSE, FilteredPath, ReducedRankEkfOptions

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
) -> FilteredPath:
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
    rotations, places, covariance = (np.stack(each) for each in zip(*found, strict=True))
    return FilteredPath(rotations, places, covariance)


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


def systematic(shares: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return indices drawn as often as shares say, by one draw at even distances, shape (K,)."""
    count = len(shares)
    at = (rng.uniform() + np.arange(count)) / count
    return np.minimum(np.searchsorted(np.cumsum(shares), at), count - 1)

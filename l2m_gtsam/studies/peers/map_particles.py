"""Localisation in a known map by a particle filter, after A. Solin et al. (ENC 2016).

Particles follow odometry with its drift. Each weighs as much as it predicts the strength of the
field at the sensors: strength does not depend on the attitude, so that calibrated sensors of any
orientation take part alike. Where few particles carry the weight, they are drawn anew.
"""

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.options import Options
from l2m_gtsam.slam.drift import drift_covariance
from l2m_gtsam.slam.options import DriftOptions
from l2m_gtsam.studies.peers.particle_slam import moments, systematic
from l2m_gtsam.studies.peers.reduced_rank_ekf import POSE, FilteredPath

AXES = 3


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
) -> FilteredPath:
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
    rotations, places, covariances = (np.stack(each) for each in zip(*found, strict=True))
    return FilteredPath(rotations, places, covariances)

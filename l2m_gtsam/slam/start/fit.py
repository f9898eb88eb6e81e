r"""How likely a window of a drive is where it is thought to be: all that is uncertain together.

The residuals of all readings are normal numbers of mean J x and covariance

.. math::
    S = D + A Q A^T + K P K^T + F M F^T

x: a perturbation of the first key pose, of which little but up is known beforehand; D: noise; Q:
odometry's steps; P: the sensors' calibrations; M: the map's errors. A reading that the others do
not predict within its covariance has the variance of the map's whole field on top: it says next to
nothing, like one that the map knows nothing of, and the likelihoods of all places stay those of the
same readings.

All residuals are correlated: a graph would be one dense factor, linearised anew at each place. What
is asked for is likelihoods; the drive from the best place is solved by GTSAM.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_factors import carried_residuals
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, RigidTransform
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.records.localisation import StartCandidate
from l2m_gtsam.slam.map_prediction import Place, Sight, look
from l2m_gtsam.slam.shared import SharedMapErrors, errors_of
from l2m_gtsam.slam.start.prior import Beforehand
from l2m_gtsam.slam.start.roots import (
    block_diagonal,
    diagonal_blocks,
    inverse,
    map_root,
    root_of,
    steps_root,
)
from l2m_gtsam.slam.start.window import Window
from l2m_gtsam.solve.noise import map_covariance, reading_covariance

ROUNDS = 3  # with covariances of their own
STEPS = 4  # in each
LONGEST = np.repeat([0.2, 0.3], 3)  # of a step: rad and m


@dataclass(frozen=True)
class Linearisation:
    """Residuals of N readings at a pose of the first key pose.

    Attributes
    ----------
    e
        Shape (3N,), uT.
    by_pose, by_calibration
        Derivatives, shapes (N, 3, 6) and (N, 3, 15).
    """

    e: FloatArray
    by_pose: FloatArray
    by_calibration: FloatArray


class WindowFit:
    """Fits a window to places of a map.

    Parameters
    ----------
    window
        The window.
    field_map
        The map.
    beforehand
        What else is known.
    """

    def __init__(self, window: Window, field_map: QueryableMap, beforehand: Beforehand) -> None:
        self._window, self._map, self._known = window, field_map, beforehand
        self._back = carried_back(window.R, window.p)[window.readings.key_pose]
        self._steps = steps_root(window)

    def at(self, T_map_lidar: RigidTransform) -> StartCandidate:
        """Return the fit that a first key pose leads to."""
        pose = T_map_lidar
        trusted = self._plausible(pose)
        for round_ in range(ROUNDS):
            seen, sight = self._linearised(pose), self._sight(pose)
            S = self._covariance(seen, sight, shared=round_ == ROUNDS - 1)
            trusted = sight.inside & self._predicted(seen.e, S, trusted)
            P = inverse(self._doubted(S, trusted))
            for _ in range(STEPS):
                pose = self._stepped(pose, seen, P)
                seen = self._linearised(pose)
        return self._told(pose, seen, P, trusted, sight.inside)

    def _told(
        self,
        pose: RigidTransform,
        seen: Linearisation,
        P: FloatArray,
        trusted: BoolArray,
        inside: BoolArray,
    ) -> StartCandidate:
        prior, _, curvature = self._known.said(pose)
        squared = float(seen.e @ P @ seen.e)
        _, log_det = np.linalg.slogdet(P)
        J = seen.by_pose.reshape(-1, 6)
        likelihood = 0.5 * (log_det - squared - len(seen.e) * np.log(2 * np.pi)) - prior
        return StartCandidate(
            T_map_lidar=pose,
            covariance=inverse(J.T @ P @ J + curvature),
            log_likelihood=float(likelihood),
            inside=float(inside.mean()),
            explained=float(trusted.sum() / max(inside.sum(), 1)),
            chi2_per_dof=squared / max(len(seen.e) - 6, 1),
        )

    def _stepped(self, pose: RigidTransform, seen: Linearisation, P: FloatArray) -> RigidTransform:
        """Return the pose after a Gauss-Newton step."""
        _, g, H = self._known.said(pose)
        J = seen.by_pose.reshape(-1, 6)
        step = -np.linalg.solve(J.T @ P @ J + H, J.T @ (P @ seen.e) + g)
        step /= max(float(np.max(np.abs(step) / LONGEST)), 1.0)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return RigidTransform(pose.R @ turn, pose.t + pose.R @ step[3:])

    def _linearised(self, pose: RigidTransform) -> Linearisation:
        window, sensors = self._window, self._window.sensors
        R, p = self._key_poses(pose)
        seen = carried_residuals(window.readings, self._map, R, p, sensors.fixed())
        reading = seen.reading
        return Linearisation(
            reading.residual.ravel(),
            seen.de_dX @ self._back,
            np.concatenate([reading.de_dt, reading.de_dD], axis=2),
        )

    def _key_poses(self, pose: RigidTransform) -> tuple[FloatArray, FloatArray]:
        """Return the key pose of each reading in the map."""
        key = self._window.readings.key_pose
        return pose.R @ self._window.R[key], self._window.p[key] @ pose.R.T + pose.t

    def _sight(self, pose: RigidTransform) -> Sight:
        """Ask the map where it has data, and how uncertain it is."""
        sensors = self._window.sensors
        at = self._window.readings.placed(*self._key_poses(pose))
        x = np.einsum("nij,nj->ni", at.R_map_lidar, sensors.t[at.sensor]) + at.p_map_lidar
        C = sensors.distortion[:, :9].reshape(-1, 3, 3)[at.sensor]
        return look(self._map, Place(at, x, C), sensors)

    def _covariance(self, seen: Linearisation, sight: Sight, *, shared: bool) -> FloatArray:
        """Return S, shape (3N, 3N)."""
        window, where = self._window, sight.place
        variance, roots = sight.map_variance, [self._odometry_root(seen)]
        roots += [self._calibration_root(seen, i) for i in range(len(window.sensors.names))]
        if shared and sight.inside.any():
            errors = SharedMapErrors.over(errors_of(self._map), sight)
            variance, roots = errors.rest, [*roots, map_root(errors, where.C)]
        variance = np.where(sight.inside[:, None], variance, 0.0)
        share = map_covariance(where.C, where.readings.R_map_lidar, variance)
        noise = window.sensors.noise[where.readings.sensor]
        S = block_diagonal(reading_covariance(noise, share))
        root = np.concatenate(roots, axis=1)
        return np.asarray(S + root @ root.T)

    def _odometry_root(self, seen: Linearisation) -> FloatArray:
        """Return a root of what odometry's steps add to S: those before a reading move it."""
        later = self._window.readings.key_pose[:, None] > np.arange(len(self._steps))
        A = np.einsum("nab,kbc->nakc", seen.by_pose, self._steps)
        return np.asarray((A * later[:, None, :, None]).reshape(len(seen.e), -1))

    def _calibration_root(self, seen: Linearisation, sensor: int) -> FloatArray:
        """Return a root of what a sensor's calibration adds to S."""
        own = (self._window.readings.sensor == sensor)[:, None, None]
        K = np.where(own, seen.by_calibration, 0.0)
        return np.asarray((K @ root_of(self._window.sensors.covariance[sensor])).reshape(-1, 15))

    def _plausible(self, pose: RigidTransform) -> BoolArray:
        """Return which readings are within their own covariances, shape (N,)."""
        seen, sight = self._linearised(pose), self._sight(pose)
        blocks = diagonal_blocks(self._covariance(seen, sight, shared=False))
        return sight.inside & self._passes(seen.e.reshape(-1, 3), inverse(blocks))

    def _predicted(self, e: FloatArray, S: FloatArray, trusted: BoolArray) -> BoolArray:
        """Return which readings those of the others that are trusted predict, shape (N,)."""
        P = inverse(self._doubted(S, trusted))
        left_out = inverse(diagonal_blocks(P))
        missed = np.einsum("nij,nj->ni", left_out, (P @ e).reshape(-1, 3))
        own = left_out - self._doubt(trusted)[:, None, None] * np.eye(3)
        return self._passes(missed, inverse(own))

    def _passes(self, e: FloatArray, information: FloatArray) -> BoolArray:
        return np.asarray(np.einsum("ni,nij,nj->n", e, information, e) <= self._known.largest)

    def _doubt(self, trusted: BoolArray) -> FloatArray:
        return np.where(trusted, 0.0, self._known.spread**2)

    def _doubted(self, S: FloatArray, trusted: BoolArray) -> FloatArray:
        """Return S with the variance of readings that are not trusted."""
        return np.asarray(S + np.diag(np.repeat(self._doubt(trusted), 3)))

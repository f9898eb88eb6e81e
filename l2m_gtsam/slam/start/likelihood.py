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
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from l2m_factors import key_pose_residuals, skew
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, RigidTransform
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.records.localisation import StartCandidate
from l2m_gtsam.slam.map_prediction import (
    MapPrediction,
    PlacedReadings,
    SharedMapErrors,
    errors_of,
    predict,
)
from l2m_gtsam.slam.start.window import Window
from l2m_gtsam.solve.linear_algebra import covariance_root, inverse
from l2m_gtsam.solve.noise import map_covariance, reading_covariance

UNKNOWN = np.repeat([10.0, 1e3], 3)  # rad and m: sigmas of what nothing is known of
ROUNDING = 1e-12  # of a variance in m^2 or uT^2: as good as none
ROUNDS = 3  # with covariances of their own
STEPS = 4  # in each
LONGEST = np.repeat([0.2, 0.3], 3)  # of a step: rad and m


@dataclass(frozen=True)
class StartPrior:
    """What is known before readings are looked at.

    Attributes
    ----------
    up
        The map's z axis in the frame of the first key pose, shape (3,).
    tilt
        Its standard deviation about each axis, rad.
    height, height_m
        Of the first key pose in the map, and its standard deviation, metres.
    spread
        Standard deviation per axis of the map's field from place to place, uT.
    largest
        Largest squared length of a whitened residual that passes for noise.
    """

    up: FloatArray
    tilt: float
    height: float
    height_m: float
    spread: float
    largest: float

    def said(self, at: RigidTransform) -> tuple[float, FloatArray, FloatArray]:
        """Return half the squared error in sigmas of a pose, with its derivatives (6,) and (6, 6).

        By a right perturbation, rotation before translation.
        """
        leans = at.R[2] - self.up
        rises = at.t[2] - self.height
        J = np.zeros((4, 6))
        J[:3, :3], J[3, 3:] = skew(at.R[2:])[0] / self.tilt, at.R[2] / self.height_m
        e = np.append(leans / self.tilt, rises / self.height_m)
        return float(0.5 * e @ e), J.T @ e, J.T @ J + np.diag(UNKNOWN**-2)


def steps_root(window: Window) -> FloatArray:
    """Return what a unit of each step's errors moves the first frame by, shape (K - 1, 6, 6).

    As seen from what comes after the step.
    """
    back = carried_back(window.R[1:], window.p[1:])
    return np.asarray(np.linalg.solve(back, np.linalg.cholesky(window.covariance)))


def map_root(errors: SharedMapErrors, C: FloatArray) -> FloatArray:
    """Return a root of what the map's errors add to S, shape (3N, K)."""
    columns = []
    for tile, size in errors.sizes.items():
        F = np.zeros((len(C), 3, size))
        own = errors.owner == tile
        F[own] = C[own] @ errors.features[tile]
        columns.append(F.reshape(-1, size))
    W = errors.root_information
    return np.asarray(
        solve_triangular(W, np.concatenate(columns, axis=1).T, lower=True, trans="T").T
    )


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """Return N blocks, shape (N, 3, 3), as one matrix, shape (3N, 3N)."""
    N = len(blocks)
    S = np.zeros((N, 3, N, 3))
    S[np.arange(N), :, np.arange(N)] = blocks
    return S.reshape(3 * N, 3 * N)


def diagonal_blocks(S: FloatArray) -> FloatArray:
    """Return the blocks of three rows on the diagonal, shape (N, 3, 3)."""
    N = len(S) // 3
    return np.asarray(S.reshape(N, 3, N, 3)[np.arange(N), :, np.arange(N)])


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

    def __init__(self, window: Window, field_map: QueryableMap, beforehand: StartPrior) -> None:
        self._window, self._map, self._known = window, field_map, beforehand
        self._back = carried_back(window.R, window.p)[window.readings.key_pose]
        self._steps = steps_root(window)

    def at(self, T_map_lidar: RigidTransform) -> StartCandidate:
        """Return the fit that a first key pose leads to."""
        pose = T_map_lidar
        trusted = self._plausible(pose)
        for round_ in range(ROUNDS):
            seen, prediction = self._linearised(pose), self._prediction(pose)
            S = self._covariance(seen, prediction, shared=round_ == ROUNDS - 1)
            trusted = prediction.inside & self._predicted(seen.e, S, trusted)
            P = inverse(self._doubted(S, trusted))
            for _ in range(STEPS):
                pose = self._stepped(pose, seen, P)
                seen = self._linearised(pose)
        return self._told(pose, seen, P, trusted, prediction.inside)

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
        seen = key_pose_residuals(window.readings, self._map, R, p, sensors.fixed())
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

    def _prediction(self, pose: RigidTransform) -> MapPrediction:
        """Ask the map where it has data, and how uncertain it is."""
        sensors = self._window.sensors
        at = self._window.readings.placed(*self._key_poses(pose))
        x = np.einsum("nij,nj->ni", at.R_map_lidar, sensors.t[at.sensor]) + at.p_map_lidar
        C = sensors.distortion[:, :9].reshape(-1, 3, 3)[at.sensor]
        return predict(self._map, PlacedReadings(at, x, C), sensors)

    def _covariance(
        self, seen: Linearisation, prediction: MapPrediction, *, shared: bool
    ) -> FloatArray:
        """Return S, shape (3N, 3N)."""
        window, where = self._window, prediction.placed
        variance, roots = prediction.map_variance, [self._odometry_root(seen)]
        roots += [self._calibration_root(seen, i) for i in range(len(window.sensors.names))]
        if shared and prediction.inside.any():
            errors = SharedMapErrors.over(errors_of(self._map), prediction)
            variance, roots = errors.rest, [*roots, map_root(errors, where.C)]
        variance = np.where(prediction.inside[:, None], variance, 0.0)
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
        P = self._window.sensors.covariance[sensor]
        sigma = np.sqrt(np.maximum(np.diag(P), ROUNDING))
        return np.asarray((K @ covariance_root(P, sigma)).reshape(-1, 15))

    def _plausible(self, pose: RigidTransform) -> BoolArray:
        """Return which readings are within their own covariances, shape (N,)."""
        seen, prediction = self._linearised(pose), self._prediction(pose)
        blocks = diagonal_blocks(self._covariance(seen, prediction, shared=False))
        return prediction.inside & self._passes(seen.e.reshape(-1, 3), inverse(blocks))

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

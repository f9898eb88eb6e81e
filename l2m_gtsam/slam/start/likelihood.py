r"""Likelihood of a window of a drive at a pose in a map, with all uncertainties marginalised.

The residuals of all readings are normal numbers of mean J x and covariance

.. math::
    S = D + A Q A^T + K P K^T + F M F^T

x: a perturbation of the first key pose, of which little but the vertical is known; D: noise; Q:
odometry's steps; P: the sensors' calibrations; M: the map's errors. A reading that the others do
not predict within its covariance gets the variance of the map's whole field in addition, like one
outside of the map: it is nearly ignored, and the likelihoods of all poses remain those of the same
readings.

All residuals are correlated: a graph would be one dense factor, relinearised at each pose. Only
likelihoods are needed; GTSAM solves the drive from the best pose.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, solve_triangular
from scipy.spatial.transform import Rotation

from l2m_factors import key_pose_residuals, skew
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, RigidTransform
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.records.localisation import StartCandidate
from l2m_gtsam.slam.map_errors import SharedMapErrors, errors_of
from l2m_gtsam.slam.map_prediction import MapPrediction, PlacedReadings, predict
from l2m_gtsam.slam.start.window import DriveWindow
from l2m_gtsam.solve.linear_algebra import covariance_root, inverse
from l2m_gtsam.solve.noise import map_covariance, reading_covariance

UNKNOWN = np.repeat([10.0, 1e3], 3)  # rad and m: sigmas of an uninformative prior
ROUNDING = 1e-12  # least variance of a calibration in m^2 or uT^2
ROUNDS = 3  # updates of the covariance
STEPS = 4  # Gauss-Newton steps in each
LONGEST = np.repeat([0.2, 0.3], 3)  # limit of a step: rad and m


@dataclass(frozen=True)
class StartPrior:
    """Prior of the first key pose, and of readings that the map does not explain.

    Attributes
    ----------
    up
        The map's z axis in the frame of the first key pose, shape (3,).
    tilt
        Its standard deviation about each axis, rad.
    height, height_m
        Of the first key pose in the map, and its standard deviation, metres.
    spread
        Standard deviation of the map's field over its places, per axis, uT.
    largest
        Gate: limit of a whitened residual's squared length.
    """

    up: FloatArray
    tilt: float
    height: float
    height_m: float
    spread: float
    largest: float

    def cost(self, at: RigidTransform) -> tuple[float, FloatArray, FloatArray]:
        """Return the negative log density of a pose, its gradient (6,) and Hessian (6, 6).

        By a right perturbation, rotation before translation, and but for a constant.
        """
        tilt, rise = at.R[2] - self.up, at.t[2] - self.height
        J = np.zeros((4, 6))
        J[:3, :3], J[3, 3:] = skew(at.R[2:])[0] / self.tilt, at.R[2] / self.height_m
        e = np.append(tilt / self.tilt, rise / self.height_m)
        return float(0.5 * e @ e), J.T @ e, J.T @ J + np.diag(UNKNOWN**-2)


def steps_root(window: DriveWindow) -> FloatArray:
    """Return roots of the steps' covariances as perturbations of the first frame, (K - 1, 6, 6).

    A perturbation of a step moves all that comes after it as if the first key pose had moved.
    """
    back = carried_back(window.R[1:], window.p[1:])
    return np.asarray(np.linalg.solve(back, np.linalg.cholesky(window.covariance)))


def map_root(errors: SharedMapErrors, C: FloatArray) -> FloatArray:
    """Return a root of the map's share of S, shape (3N, K)."""
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


def diagonal_blocks(S: FloatArray) -> FloatArray:
    """Return the blocks of three rows on the diagonal, shape (N, 3, 3)."""
    N = len(S) // 3
    return np.asarray(S.reshape(N, 3, N, 3)[np.arange(N), :, np.arange(N)])


@dataclass(frozen=True)
class WindowResiduals:
    """Residuals of N readings at a pose of the first key pose.

    Attributes
    ----------
    e
        Shape (3N,), uT.
    by_pose, by_calibration
        Derivatives by the first key pose, shape (N, 3, 6), and the calibration, (N, 3, 15).
    """

    e: FloatArray
    by_pose: FloatArray
    by_calibration: FloatArray


class WindowFit:
    """Fits a window at poses in a map.

    Parameters
    ----------
    window
        K key poses and N readings.
    field_map
        Map that is queried for field, gradient and variance.
    prior
        Of the first key pose.
    """

    def __init__(self, window: DriveWindow, field_map: QueryableMap, prior: StartPrior) -> None:
        self._window, self._map, self._prior = window, field_map, prior
        self._back = carried_back(window.R, window.p)[window.readings.key_pose]
        self._steps = steps_root(window)

    def at(self, T_map_lidar: RigidTransform) -> StartCandidate:
        """Return the fit from an initial first key pose."""
        pose = T_map_lidar
        trusted = self._plausible(pose)
        for round_ in range(ROUNDS):
            residuals, prediction = self._linearised(pose), self._prediction(pose)
            S = self._covariance(residuals, prediction, shared=round_ == ROUNDS - 1)
            trusted = prediction.inside & self._predicted(residuals.e, S, trusted)
            P = inverse(self._inflated(S, trusted))
            for _ in range(STEPS):
                pose = self._stepped(pose, residuals, P)
                residuals = self._linearised(pose)
        return self._candidate(pose, residuals, P, trusted, prediction.inside)

    def _candidate(
        self,
        pose: RigidTransform,
        residuals: WindowResiduals,
        P: FloatArray,
        trusted: BoolArray,
        inside: BoolArray,
    ) -> StartCandidate:
        prior, _, curvature = self._prior.cost(pose)
        squared = float(residuals.e @ P @ residuals.e)
        _, log_det = np.linalg.slogdet(P)
        J = residuals.by_pose.reshape(-1, 6)
        likelihood = 0.5 * (log_det - squared - len(residuals.e) * np.log(2 * np.pi)) - prior
        return StartCandidate(
            T_map_lidar=pose,
            covariance=inverse(J.T @ P @ J + curvature),
            log_likelihood=float(likelihood),
            inside=float(inside.mean()),
            explained=float(trusted.sum() / max(inside.sum(), 1)),
            chi2_per_dof=squared / max(len(residuals.e) - 6, 1),
        )

    def _stepped(
        self, pose: RigidTransform, residuals: WindowResiduals, P: FloatArray
    ) -> RigidTransform:
        """Return the pose after a Gauss-Newton step."""
        _, g, H = self._prior.cost(pose)
        J = residuals.by_pose.reshape(-1, 6)
        step = -np.linalg.solve(J.T @ P @ J + H, J.T @ (P @ residuals.e) + g)
        step /= max(float(np.max(np.abs(step) / LONGEST)), 1.0)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return RigidTransform(pose.R @ turn, pose.t + pose.R @ step[3:])

    def _linearised(self, pose: RigidTransform) -> WindowResiduals:
        window, sensors = self._window, self._window.sensors
        R, p = self._key_poses(pose)
        residuals = key_pose_residuals(window.readings, self._map, R, p, sensors.fixed())
        reading = residuals.reading
        return WindowResiduals(
            reading.residual.ravel(),
            residuals.de_dX @ self._back,
            np.concatenate([reading.de_dt, reading.de_dD], axis=2),
        )

    def _key_poses(self, pose: RigidTransform) -> tuple[FloatArray, FloatArray]:
        """Return the key pose of each reading in the map."""
        key = self._window.readings.key_pose
        return pose.R @ self._window.R[key], self._window.p[key] @ pose.R.T + pose.t

    def _prediction(self, pose: RigidTransform) -> MapPrediction:
        """Query the map at the readings."""
        sensors = self._window.sensors
        at = self._window.readings.placed(*self._key_poses(pose))
        return predict(self._map, PlacedReadings.of(at, sensors), sensors)

    def _covariance(
        self, residuals: WindowResiduals, prediction: MapPrediction, *, shared: bool
    ) -> FloatArray:
        """Return S, shape (3N, 3N)."""
        window, where = self._window, prediction.placed
        variance, roots = prediction.map_variance, [self._odometry_root(residuals)]
        roots += [self._calibration_root(residuals, i) for i in range(len(window.sensors.names))]
        if shared and prediction.inside.any():
            errors = SharedMapErrors.over(errors_of(self._map), prediction)
            variance, roots = errors.rest, [*roots, map_root(errors, where.C)]
        variance = np.where(prediction.inside[:, None], variance, 0.0)
        share = map_covariance(where.C, where.readings.R_map_lidar, variance)
        noise = window.sensors.noise[where.readings.sensor]
        S = block_diag(*reading_covariance(noise, share))
        root = np.concatenate(roots, axis=1)
        return np.asarray(S + root @ root.T)

    def _odometry_root(self, residuals: WindowResiduals) -> FloatArray:
        """Return a root of odometry's share of S: all steps before a reading move it."""
        later = self._window.readings.key_pose[:, None] > np.arange(len(self._steps))
        A = np.einsum("nab,kbc->nakc", residuals.by_pose, self._steps)
        return np.asarray((A * later[:, None, :, None]).reshape(len(residuals.e), -1))

    def _calibration_root(self, residuals: WindowResiduals, sensor: int) -> FloatArray:
        """Return a root of the share of S of a sensor's calibration."""
        own = (self._window.readings.sensor == sensor)[:, None, None]
        K = np.where(own, residuals.by_calibration, 0.0)
        P = self._window.sensors.covariance[sensor]
        sigma = np.sqrt(np.maximum(np.diag(P), ROUNDING))
        return np.asarray((K @ covariance_root(P, sigma)).reshape(-1, 15))

    def _plausible(self, pose: RigidTransform) -> BoolArray:
        """Return which readings pass the gate of their own covariances, shape (N,)."""
        residuals, prediction = self._linearised(pose), self._prediction(pose)
        blocks = diagonal_blocks(self._covariance(residuals, prediction, shared=False))
        return prediction.inside & self._passes(residuals.e.reshape(-1, 3), inverse(blocks))

    def _predicted(self, e: FloatArray, S: FloatArray, trusted: BoolArray) -> BoolArray:
        """Return which readings the trusted others predict, shape (N,)."""
        # Leave-one-out prediction: with P = S^-1 the error of reading n is P_nn^-1 (P e)_n, of
        # covariance P_nn^-1 (O. Dubrule, Mathematical Geology 15, 1983).
        P = inverse(self._inflated(S, trusted))
        left_out = inverse(diagonal_blocks(P))
        missed = np.einsum("nij,nj->ni", left_out, (P @ e).reshape(-1, 3))
        own = left_out - self._field_variance(trusted)[:, None, None] * np.eye(3)
        return self._passes(missed, inverse(own))

    def _passes(self, e: FloatArray, information: FloatArray) -> BoolArray:
        return np.asarray(np.einsum("ni,nij,nj->n", e, information, e) <= self._prior.largest)

    def _field_variance(self, trusted: BoolArray) -> FloatArray:
        return np.where(trusted, 0.0, self._prior.spread**2)

    def _inflated(self, S: FloatArray, trusted: BoolArray) -> FloatArray:
        """Return S with the field's variance added for readings that are not trusted."""
        return np.asarray(S + np.diag(np.repeat(self._field_variance(trusted), 3)))

r"""What readings determine of a path in an unknown field, by second derivatives of its density.

With xi the errors of odometry in units of their sigmas, c those of the sensors, and B the second
derivatives of :math:`-\log p(z | X)` by both (see :mod:`.path_density`), the covariance of (xi, c)
is that of Laplace's approximation,

.. math::
    (I + B)^{-1} = I - U \, \mathrm{diag}(l / (1 + l)) \, U^T

with the eigenvalues l of B. Readings determine few directions, which Lanczos' iteration finds from
products with B; all others stay as odometry has them (T. Bui-Thanh, O. Ghattas, J. Martin,
G. Stadler, SIAM Journal on Scientific Computing 35, 2013). Where the estimate is not at the mode,
some l are negative: readings hold the path nowhere along these directions, which stay, too.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from l2m_factors import G, V, X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import Drive, KnownSensors, stacked
from l2m_gtsam.slam.marginals import Marginals, pose_covariances
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.pose_graph import odometry_graph
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solver import colamd_ordering
from l2m_gtsam.slam.unknown_field.path_density import InverseNoise, PathDensity, PathReadings
from l2m_gtsam.slam.unknown_field.whole_field import WholeField
from l2m_gtsam.solve.linear_algebra import covariance_root, eigenpairs

VECTORS = 120  # of Lanczos' iteration; with twice as many sigmas are 4 to 5 % smaller
LEAST = 0.01  # eigenvalue: less of it would change a variance by 1 %
SIDE = 1e-3  # of a finite difference, in sigmas
SEED = 24  # of the iteration's first vector


@dataclass(frozen=True)
class PathInformation:
    """Covariances of a path and its sensors: by odometry, less what readings determine.

    Attributes
    ----------
    odometry
        Of the poses by odometry alone.
    learnt
        Root of what readings take from the covariance of K poses, shape (K, 6, q).
    sensors
        Root of what they take from that of (t, C row by row, H) of each sensor, shape (S, 15, q).
    narrowed
        By how much readings narrow the volume of the path's errors, in nats.
    """

    odometry: Marginals
    learnt: FloatArray
    sensors: FloatArray
    narrowed: float

    def pose_covariances(self) -> FloatArray:
        """Return covariances of right perturbations of the key poses, shape (K, 6, 6)."""
        before = pose_covariances(self.odometry, len(self.learnt))
        return np.asarray(before - self.learnt @ self.learnt.transpose(0, 2, 1))

    def step_covariance(self, step: int) -> FloatArray:
        """Return the joint covariance of the poses before and after a step, (12, 12)."""
        own = self.learnt[step : step + 2].reshape(2 * POSE, -1)
        return np.asarray(self.odometry.joint([X(step), X(step + 1)]) - own @ own.T)

    def variance_along(self, directions: Mapping[int, FloatArray], /) -> float:
        """Return ``d^T P d`` for a direction d in which poses move; see ``Marginals``."""
        along = np.zeros(self.learnt.shape[2])
        for k, own in enumerate(self.learnt):
            if X(k) in directions:
                along += directions[X(k)] @ own
        return self.odometry.variance_along(directions) - float(along @ along)


def path_information(near: "PathNeighbourhood") -> PathInformation:
    """Return what readings determine of a path."""
    taken = determined(near)
    learnt, sensors = near.moved_by(taken)
    return PathInformation(near.odometry, learnt, sensors, near.narrowed(taken))


def determined(near: "PathNeighbourhood", count: int = VECTORS) -> FloatArray:
    """Return a root of what readings take from the covariance I of n errors, shape (n, q).

    Parameters
    ----------
    near
        The density at errors.
    count
        Products of Lanczos' iteration. With fewer, less is found, so that sigmas are larger.
    """
    here = near.slopes(np.zeros(near.size))
    first = np.random.default_rng(SEED).normal(size=near.size)
    found, vectors = eigenpairs(
        lambda v: (near.slopes(SIDE * v) - here) / SIDE, first, min(count, near.size)
    )
    known = found > LEAST
    return np.asarray(vectors[:, known] * np.sqrt(found[known] / (1 + found[known])))


@dataclass(frozen=True)
class ErrorSlopes:
    """Minus the log density of readings but for constants, and its derivatives by n errors."""

    cost: float
    by_errors: FloatArray


class PathNeighbourhood:
    """The density of readings where odometry and sensors have other errors than estimated.

    Errors are those of odometry's steps, start and what they have in common, then those of the
    sensors, all in units of their sigmas and relative to the estimate.

    Parameters
    ----------
    drive
        K key poses with readings of S sensors, with calibrations at the estimate and the
        covariances of their priors.
    poses, values
        The estimates, and with them those of odometry's steady drift or scale.
    field
        In the frame of the first key pose.
    noise
        Of the readings.
    """

    def __init__(
        self,
        drive: Drive,
        poses: list[gtsam.Pose3],
        values: gtsam.Values,
        field: WholeField,
        noise: InverseNoise,
    ) -> None:
        graph = odometry_graph(drive)
        linear = graph.linearize(values)
        self.odometry = Marginals(linear, colamd_ordering(graph))
        # As many errors as variables: those of the keys G and V come before those of the poses.
        row, column, entry = linear.sparseJacobian_()
        self._steps = int(column.max()) - 1  # the last column is the right-hand side
        self._others = self._steps - POSE * len(poses)
        left, shape = column <= self._steps, (self._steps, self._steps)
        at = (row[left].astype(np.int64) - 1, column[left].astype(np.int64) - 1)
        by_variables = csc_array((entry[left], at), shape=shape)
        self._root, self._transposed = splu(by_variables), splu(csc_array(by_variables.T))
        self._right = np.zeros(self._steps)
        self._right[row[~left].astype(np.int64) - 1] = entry[~left]
        motions = RelativeMotions.along(drive, poses)
        readings, self._by_pose = path_readings(motions, poses)
        self.density = PathDensity(readings, field, noise)
        self.sensors = drive.sensors.vectors()
        self._by_sensor = block_diag(
            *(covariance_root(P, np.sqrt(np.diag(P))) for P in drive.sensors.covariance)
        )
        self._values = values

    @property
    def size(self) -> int:
        """Number n of errors."""
        return self._steps + self.sensors.size

    def errors_from(self, stated: KnownSensors) -> FloatArray:
        """Return the errors of the estimate itself, for calibrations that are stated, (n,)."""
        off = (self.sensors - stated.vectors()).ravel()
        own = np.linalg.lstsq(self._by_sensor, off, rcond=None)[0]
        return np.concatenate([-self._right, own])

    def narrowed(self, taken: FloatArray) -> float:
        """Return minus half the log determinant of the covariance P of the path's errors.

        ``taken`` is the result of ``determined``. With those U of its rows that are not the
        sensor's, ``P = I - U U^T`` has the determinant of ``I - U^T U``.
        """
        U = taken[: self._steps]
        return -0.5 * float(np.linalg.slogdet(np.eye(U.shape[1]) - U.T @ U)[1])

    def slopes(self, errors: FloatArray) -> FloatArray:
        """Return the derivatives of minus the log density where errors are so, both (n,)."""
        return self.density_at(errors).by_errors

    def density_at(self, errors: FloatArray) -> ErrorSlopes:
        """Return minus the log density of readings where errors (n,) are so, and its slopes."""
        poses, sensors = self.moved_by(errors[:, None])
        moved = (self._by_pose @ poses.ravel()).reshape(-1, POSE)
        found = self.density.slopes(moved, self.sensors + sensors[:, :, 0])
        by_poses, none = self.by_key_poses(found.by_path[None]), np.zeros((1, DRIFT))
        by_errors = self.by_errors(by_poses, none, found.by_sensor.reshape(1, -1))[0]
        return ErrorSlopes(found.cost, np.asarray(by_errors))

    def moved_values(self, errors: FloatArray) -> gtsam.Values:
        """Return poses, and odometry's steady drift or scale, where errors (n,) are so."""
        moved, values = self._root.solve(errors[: self._steps]), gtsam.Values()
        own = moved[: self._others]
        if self._values.exists(G()):
            values.insert(G(), self._values.atDouble(G()) + float(own[0]))
        if self._values.exists(V()):
            values.insert(V(), self._values.atVector(V()) + own)
        for k, delta in enumerate(moved[self._others :].reshape(-1, POSE)):
            values.insert(X(k), self._values.atPose3(X(k)).retract(delta))
        return values

    def by_errors(
        self, by_poses: FloatArray, by_drift: FloatArray, by_sensor: FloatArray
    ) -> FloatArray:
        """Return derivatives of r quantities by all errors, shape (r, n).

        Parameters
        ----------
        by_poses
            By right perturbations of K key poses, shape (r, K, 6).
        by_drift
            By odometry's steady drift, shape (r, 8); it counts where that is a variable.
        by_sensor
            By (t, C row by row, H) of each sensor, shape (r, 15 S).
        """
        flat = by_poses.reshape(len(by_poses), -1)
        others = by_drift if self._others == DRIFT else np.zeros((len(flat), self._others))
        by_steps = self._transposed.solve(np.hstack([others, flat]).T).T
        return np.hstack([by_steps, by_sensor @ self._by_sensor])

    def by_key_poses(self, by_readings: FloatArray) -> FloatArray:
        """Return derivatives by K key poses (r, K, 6) from those by N readings' poses (r, N, 6)."""
        flat = by_readings.reshape(len(by_readings), -1)
        return np.asarray((self._by_pose.T @ flat.T).T.reshape(len(flat), -1, POSE))

    def moved_by(self, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how q errors (n, q) move K poses, (K, 6, q), and the sensors, (S, 15, q)."""
        steps = np.asarray(self._root.solve(errors[: self._steps]))
        poses = steps[self._others :].reshape(-1, POSE, errors.shape[1])
        sensors = self._by_sensor @ errors[self._steps :]
        return poses, sensors.reshape(*self.sensors.shape, -1)


def path_readings(
    motions: RelativeMotions, poses: list[gtsam.Pose3]
) -> tuple[PathReadings, csr_array]:
    """Return readings in the frame of the first key pose, and how the lidar moves with key poses.

    The latter are derivatives of right perturbations at the N readings by those of K key poses,
    shape (6 N, 6 K). A reading moves with both ends of its step, and against the frame.
    """
    readings, key = motions.readings, motions.readings.key_pose
    R_key, p_key = (each[key] for each in stacked([poses[0].between(pose) for pose in poses]))
    R = R_key @ readings.R_key_lidar
    p = np.einsum("nij,nj->ni", R_key, readings.p_key_lidar) + p_key
    R_step, p_step = (each[key] for each in stacked(motions.steps))
    by_end = readings.fraction[:, None, None] * motions.by_step
    by_key = carried_back(readings.R_key_lidar, readings.p_key_lidar)
    by_key -= by_end @ carried_back(R_step, p_step)
    blocks = np.stack([by_key, by_end, -carried_back(R, p)])
    own, of = np.arange(POSE), np.stack([key, key + 1, np.zeros_like(key)])
    row = POSE * np.arange(len(key))[:, None, None] + own[:, None]
    column = POSE * of[:, :, None, None] + own
    at = tuple(np.broadcast_to(each, blocks.shape).ravel() for each in (row, column))
    shape = POSE * len(key), POSE * len(poses)
    at_estimate = PathReadings(R, p, readings.field, readings.sensor)
    return at_estimate, csr_array((blocks.ravel(), at), shape=shape)

r"""What readings say of a path in an unknown field, by second derivatives of its density.

With xi the errors of odometry in units of their sigmas, c those of the sensor, and B the second
derivatives of :math:`-\log p(z | X)` by both (see :mod:`.path_density`), the covariance of (xi, c)
is that of Laplace's approximation,

.. math::
    (I + B)^{-1} = I - U \, \mathrm{diag}(l / (1 + l)) \, U^T

with the eigenvalues l of B. Readings determine few directions, which Lanczos' iteration finds from
products with B; all others stay as odometry has them (T. Bui-Thanh, O. Ghattas, J. Martin,
G. Stadler, 2013, on such covariances). Where the estimate is not quite at the mode, some l are
negative: there the readings are likelier further off on both sides, and nothing counts as known.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import eigh_tridiagonal
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from l2m_factors import X
from l2m_gtsam.data import FloatArray
from l2m_gtsam.geometry import carried_back
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.pose_graph import odometry_graph
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solver import Marginals, colamd_ordering, pose_covariances
from l2m_gtsam.slam.unknown_field.path_density import PathDensity, PathReadings
from l2m_gtsam.slam.unknown_field.sensor_noise import NS, NoiseInformation, SensorNoise
from l2m_gtsam.slam.unknown_field.whole_field import WholePrior
from l2m_gtsam.solve.linear_algebra import covariance_root

VECTORS = 120  # of Lanczos' iteration
LEAST = 0.01  # eigenvalue: less of it would change a variance by 1 %
SIDE = 1e-3  # of a finite difference, in sigmas
DRAWN = 24  # of the iteration's first vector

Product = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class PathInformation:
    """Covariances of a path and its sensor, by odometry less what readings determine.

    Attributes
    ----------
    odometry
        Of the poses by odometry alone.
    learnt
        Roots of what readings take from the covariance of K poses, shape (K, 6, q).
    sensor
        The same of (t, C row by row, H), shape (15, q).
    """

    odometry: Marginals
    learnt: FloatArray
    sensor: FloatArray

    def pose_covariances(self) -> FloatArray:
        """Return covariances of right perturbations of the key poses, shape (K, 6, 6)."""
        before = pose_covariances(self.odometry, len(self.learnt))
        return np.asarray(before - self.learnt @ self.learnt.transpose(0, 2, 1))

    def step_covariance(self, step: int) -> FloatArray:
        """Return the joint covariance of the poses before and after a step, (12, 12)."""
        own = self.learnt[step : step + 2].reshape(2 * POSE, -1)
        return np.asarray(self.odometry.joint([X(step), X(step + 1)]) - own @ own.T)

    def variance_along(self, directions: Mapping[int, FloatArray]) -> float:
        """Return ``d^T P d`` for a direction d in which poses move; see ``Marginals``."""
        along = np.zeros(self.learnt.shape[2])
        for k, own in enumerate(self.learnt):
            if X(k) in directions:
                along += directions[X(k)] @ own
        return self.odometry.variance_along(directions) - float(along @ along)


def path_information(
    drive: Drive,
    poses: list[gtsam.Pose3],
    values: gtsam.Values,
    prior: WholePrior,
    noise: SensorNoise,
    weights: FloatArray,
) -> PathInformation:
    """Return what readings say of a path.

    Parameters
    ----------
    drive
        K key poses of one sensor, with its calibration at the estimate and the prior's covariance.
    poses, values
        The estimates, and with them those of odometry's steady drift or scale.
    prior, noise
        Of the field and of the readings.
    weights
        Robust weight of each reading, positive, shape (N,).
    """
    linear = odometry_graph(drive).linearize(values)
    i, j, entry = linear.sparseJacobian_()
    count = int(j.max()) - 1  # its last column is the right-hand side
    left = j <= count
    root = splu(csc_array((entry[left], (i[left] - 1, j[left] - 1)), shape=(count, count)))
    others = count - POSE * len(poses)  # columns of the keys G or V, which come before X
    motions = RelativeMotions.along(drive, poses)
    readings, by_pose = path_readings(motions, poses)
    density = PathDensity(
        readings,
        prior.field,
        NoiseInformation(noise, NS * (drive.reading_ns - drive.stamp_ns[0]), weights),
    )
    sensors = drive.sensors
    at = np.concatenate([sensors.t[0], sensors.distortion[0]])
    by_sensor = covariance_root(sensors.covariance[0], np.sqrt(np.diag(sensors.covariance[0])))

    def gradient(off: FloatArray) -> FloatArray:
        moved = (by_pose @ root.solve(off[:count])[others:]).reshape(-1, POSE)
        slopes = density.slopes(moved, at + by_sensor @ off[count:])
        back = np.append(np.zeros(others), by_pose.T @ slopes.by_path.ravel())
        return np.append(root.solve(back, trans="T"), by_sensor.T @ slopes.by_sensor)

    here = gradient(np.zeros(count + len(at)))
    first = np.random.default_rng(DRAWN).normal(size=len(here))
    values_of, vectors = eigenpairs(
        lambda v: (gradient(SIDE * v) - here) / SIDE, first, min(VECTORS, len(here))
    )
    known = values_of > LEAST
    share = vectors[:, known] * np.sqrt(values_of[known] / (1 + values_of[known]))
    learnt = root.solve(share[:count])[others:].reshape(len(poses), POSE, -1)
    graph = odometry_graph(drive)
    return PathInformation(
        Marginals(graph.linearize(values), colamd_ordering(graph)),
        learnt,
        by_sensor @ share[count:],
    )


def path_readings(
    motions: RelativeMotions, poses: list[gtsam.Pose3]
) -> tuple[PathReadings, csr_array]:
    """Return readings in the frame of the first key pose, and how the lidar moves with key poses.

    The latter are derivatives of right perturbations at the N readings by those of K key poses,
    shape (6 N, 6 K). A reading moves with both ends of its step, and against the frame.
    """
    readings, key = motions.readings, motions.readings.key_pose
    relative = [poses[0].between(pose) for pose in poses]
    R_key = np.stack([pose.rotation().matrix() for pose in relative])[key]
    p_key = np.stack([pose.translation() for pose in relative])[key]
    R = R_key @ readings.R_key_lidar
    p = np.einsum("nij,nj->ni", R_key, readings.p_key_lidar) + p_key
    R_step = np.stack([step.rotation().matrix() for step in motions.steps])[key]
    p_step = np.stack([step.translation() for step in motions.steps])[key]
    by_end = readings.fraction[:, None, None] * motions.by_step
    by_key = carried_back(readings.R_key_lidar, readings.p_key_lidar)
    by_key -= by_end @ carried_back(R_step, p_step)
    own = np.arange(POSE)
    rows = POSE * np.arange(len(key))[:, None, None] + own[:, None] + np.zeros((1, 1, POSE), int)
    columns = POSE * np.stack([key, key + 1, np.zeros_like(key)])[:, :, None, None] + own
    blocks = np.stack([by_key, by_end, -carried_back(R, p)])
    shape = POSE * len(key), POSE * len(poses)
    at = np.broadcast_to(rows, blocks.shape), np.broadcast_to(columns, blocks.shape)
    by_pose = csr_array((blocks.ravel(), (at[0].ravel(), at[1].ravel())), shape=shape)
    return PathReadings(R, p, readings.field), by_pose


def eigenpairs(product: Product, first: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues (q,) and eigenvectors (n, q) of a symmetric matrix on a Krylov space.

    Lanczos' iteration with every vector kept orthogonal to all before (G. Golub, C. Van Loan,
    "Matrix computations", 2013, 10.3). The largest eigenvalues are found first.

    Parameters
    ----------
    product
        Of the matrix with a vector.
    first
        Vector that the space begins with, shape (n,).
    count
        Dimension of the space, n at most.
    """
    basis = np.zeros((count, len(first)))
    diagonal, beside = np.zeros(count), np.zeros(count)
    vector = first / np.linalg.norm(first)
    for j in range(count):
        basis[j] = vector
        vector = product(vector)
        diagonal[j] = vector @ basis[j]
        for _ in range(2):  # twice is enough for rounding
            vector = vector - basis[: j + 1].T @ (basis[: j + 1] @ vector)
        beside[j] = np.linalg.norm(vector)
        if beside[j] <= np.finfo(float).eps * np.abs(diagonal).max():  # the space is invariant
            count = j + 1
            break
        vector /= beside[j]
    values, vectors = eigh_tridiagonal(diagonal[:count], beside[: count - 1])
    return values, basis[:count].T @ vectors

"""Where a drive comes back to, searched for where odometry has drifted out of the field's reach.

A field is linear over about the depth of its sources. From poses that are further off than that
Levenberg-Marquardt ends beside the right place: where racks or posts repeat, at the next one. So
the end of a drive is tried at the nodes of a lattice over what odometry allows. Its path is bent to
each as odometry's errors would bend it, and the node is taken where visits to the same tiles agree
best.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import gtsam
import numpy as np
from scipy.linalg import cholesky, solve_triangular

from l2m_factors import X
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.pose_graph import link_graph, odometry_graph, shared_values
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solver import Marginals, colamd_ordering
from l2m_gtsam.slam.unknown_field.tiled_drive import OccupiedTile, anchored, occupied_tiles
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, visits_among

SIGMAS = 3.0  # of odometry, within which a place is looked for: 99 % in a plane
MOST_NODES = 400  # of the lattice; those that odometry likes best
STEP_M = (0.4, 1.0)  # least and greatest step of the lattice: depths are learnt from a few metres
CLEAR = 10.0  # nats by which another place must be likelier than that by odometry
HELD = 1e-3  # rad, m: sigma of poses that do not take part in the search
AT_NODE_M = 1e-3  # sigma of the last pose about a node


@dataclass(frozen=True)
class ReturnSearch:
    """A search for the place at which a drive ends.

    Attributes
    ----------
    drive
        K key poses.
    prior
        Of the field.
    noise
        Standard deviation of each sensor's noise that visits are compared with, uT, shape (S,).
    known
        Number of the last key pose where the vehicle was known to be back; it and those before
        stay where they are.
    begun
        Number of the first key pose whose visits are compared with earlier ones.
    """

    drive: Drive
    prior: FieldPrior
    noise: FloatArray
    known: int
    begun: int

    def likeliest(self, poses: list[gtsam.Pose3]) -> list[gtsam.Pose3]:
        """Return the likeliest of the paths that odometry allows.

        Parameters
        ----------
        poses
            K key poses, since the last return by odometry.

        Returns
        -------
        The same poses where no other path is clearly likelier.
        """
        best, most = poses, -np.inf
        for number, (path, cost) in enumerate(self._paths(poses)):
            likelihood = self.agreement(path) - cost
            if number == 0:
                most = likelihood + CLEAR
            elif likelihood > most:
                best, most = path, likelihood
        return best

    def agreement(self, poses: list[gtsam.Pose3]) -> float:
        """Return by how much readings are likelier in common tiles than with a tile for each visit.

        Parameters
        ----------
        poses
            K key poses.

        Returns
        -------
        In nats, of the tiles that the vehicle was in since ``begun`` and before.
        """
        motions = RelativeMotions.along(self.drive, poses)
        anchoring, _ = anchored(poses, self.prior)
        again = set(anchoring.tile[self.begun :].tolist())
        tiles = occupied_tiles(anchoring, motions, poses, self.drive.sensors, self.prior)
        key_pose = motions.readings.key_pose
        return sum(
            self._agreement(tile, visits_among(key_pose[tile.rows]))
            for tile in tiles
            if tile.number in again
        )

    def _agreement(self, tile: OccupiedTile, visits: list[IntArray]) -> float:
        """Return by how much visits to one tile, rows of its readings, are likelier together."""
        if len(visits) < 2:
            return 0.0
        x, noise = tile.placed.x, self.noise[tile.placed.readings.sensor, None]
        root = 1 / np.sqrt(noise**2 + tile.field.unresolved(x))
        features = tile.field.features(x) * root[:, :, None]
        whitened = tile.placed.field(self.drive.sensors) * root
        alone = sum(evidence(features[rows], whitened[rows]) for rows in visits)
        return evidence(features, whitened) - alone

    def _paths(self, poses: list[gtsam.Pose3]) -> Iterator[tuple[list[gtsam.Pose3], float]]:
        """Yield paths, the first as it is, with what they cost against odometry, in nats."""
        values = shared_values(self.drive)
        for k, pose in enumerate(poses):
            values.insert(X(k), pose)
        graph = odometry_graph(self.drive)
        graph.push_back(link_graph(self.drive.links))
        held = gtsam.noiseModel.Isotropic.Sigma(6, HELD)
        for k in range(self.known + 1):
            graph.add(gtsam.PriorFactorPose3(X(k), poses[k], held))
        linear, ordering = graph.linearize(values), colamd_ordering(graph)
        last = len(poses) - 1
        level = poses[last].rotation().matrix()[:2]  # of the map along the vehicle's axes
        by_pose = np.hstack([np.zeros((2, 3)), level])
        covariance = by_pose @ Marginals(linear, ordering).of(X(last)) @ by_pose.T
        least = linear.error(linear.optimize(ordering))
        exact = gtsam.noiseModel.Isotropic.Sigma(2, AT_NODE_M)
        yield poses, 0.0
        for node in nodes(covariance, self._reach):
            bent = gtsam.GaussianFactorGraph()
            bent.push_back(linear)
            bent.add(gtsam.JacobianFactor(X(last), by_pose, node, exact))
            delta = bent.optimize(ordering)
            path = list(poses_in(values.retract(delta), len(poses)).values())
            yield path, linear.error(delta) - least

    @property
    def _reach(self) -> float:
        """Depth of the stronger sources in metres: from so far off a place is found back to."""
        known = self.prior.hyperparameters
        on_floor = known.floor_scale >= known.ceiling_scale
        depth = known.floor_depth if on_floor else known.ceiling_depth
        return float(np.clip(depth, *STEP_M))


def nodes(covariance: FloatArray, step: float) -> FloatArray:
    """Return the nodes of a lattice over a Gaussian in a plane but its middle, likeliest first.

    Parameters
    ----------
    covariance
        Of the Gaussian, square metres, shape (2, 2).
    step
        Of the lattice along its axes in metres.

    Returns
    -------
    Shape (n, 2), metres.
    """
    variance, axes = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    count = np.minimum(SIGMAS * sigma / step, MOST_NODES).astype(int)
    along = np.array(list(product(*(np.arange(-n, n + 1) for n in count)))) * step
    squared = np.sum((along / np.maximum(sigma, step / SIGMAS)) ** 2, axis=1)
    order = np.argsort(squared, kind="stable")
    chosen = order[(squared[order] > 0) & (squared[order] <= SIGMAS**2)][:MOST_NODES]
    return np.asarray(along[chosen] @ axes.T)


def evidence(features: FloatArray, field: FloatArray) -> float:
    """Return the log likelihood of whitened readings, weights integrated out, but for constants.

    Parameters
    ----------
    features
        Of m weights of unit prior variance, shape (n, 3, m).
    field
        Whitened readings, shape (n, 3).
    """
    F, y = features.reshape(-1, features.shape[-1]), field.ravel()
    lower = cholesky(F.T @ F + np.eye(F.shape[1]), lower=True)
    c = solve_triangular(lower, F.T @ y, lower=True)
    return float(0.5 * (c @ c) - np.log(np.diag(lower)).sum())

"""Where a drive comes back to, searched for where odometry has drifted out of the field's reach.

A field is linear over about the depth of its sources. From poses that are further off than that
Levenberg-Marquardt ends beside the right place: where racks or posts repeat, at the next one. So
the end of a drive is tried at the nodes of a lattice over what odometry allows. Its path is bent to
each as odometry's errors would bend it, and the node is taken where visits to the same tiles agree
best.
"""

from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add

import gtsam
import numpy as np

from l2m_factors import KeyPoseReadings, X
from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.slam.drive import Drive
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.marginals import Marginals
from l2m_gtsam.slam.pose_graph import drive_graph, drive_values
from l2m_gtsam.slam.relative_motion import RelativeMotions
from l2m_gtsam.slam.solver import colamd_ordering
from l2m_gtsam.slam.unknown_field.changed_visits import Remembered, Seen
from l2m_gtsam.slam.unknown_field.tiled_drive import OccupiedTile, anchored, occupied_tiles
from l2m_gtsam.slam.unknown_field.tiles import FieldPrior, visits_among

SIGMAS = 3.5  # of odometry, within which a place is looked for: 99.3 % of a Gaussian in space
MOST_NODES = 300  # of the lattice; those that odometry likes best
MOST_STEPS = 20  # of the lattice along an axis, either way: a sphere of so many has 33,000 nodes
DEPTH_M = (0.4, 1.0)  # within which the sources' depth counts: it is learnt from a few metres
STEPS = (0.5, 0.63, 0.8, 1.0)  # of the lattice, in depths: the finest that has few enough nodes
REFINED = 3  # nodes about which the lattice is halved
READINGS = 6  # for each key pose, which stand for all of them with less noise
CLEAR = 10.0  # nats by which another place must be likelier than that by odometry
BESIDE = np.delete(np.indices((3, 3, 3)).reshape(3, -1).T - 1.0, 13, axis=0)  # of a node, in steps
HELD = 1e-3  # rad, m: sigma of poses that do not take part in the search
AT_NODE_M = 1e-3  # sigma of the last pose about a node


@dataclass(frozen=True)
class BentPath:
    """K key poses that end at a node of the lattice.

    Attributes
    ----------
    poses
        The poses.
    node
        Where the last one is, less where odometry has it, in the map, metres, shape (3,).
    likelihood
        How much likelier than apart their visits to common tiles are, less what the path costs
        against odometry, in nats.
    """

    poses: list[gtsam.Pose3]
    node: FloatArray
    likelihood: float


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
        bending = Bending(self.drive, poses, self.known)
        around, step = nodes(bending.covariance, self._depth)
        if not len(around):
            return poses
        # A path bends by millimetres in a step: where a reading is on its key pose stays.
        readings = few_of(RelativeMotions.along(self.drive, poses).readings, len(poses))

        def path(node: FloatArray) -> BentPath:
            bent, cost = bending.to(node)
            return BentPath(bent, node, self.agreement(readings, bent) - cost)

        paths = sorted((path(node) for node in around), key=lambda each: -each.likelihood)
        finer = np.concatenate([each.node + 0.5 * step * BESIDE for each in paths[:REFINED]])
        best = max([paths[0], *map(path, finer)], key=lambda each: each.likelihood)
        # Visits that are likelier apart than together are no return.
        now = max(self.agreement(readings, poses), 0.0)
        return best.poses if best.likelihood > now + CLEAR else poses

    def apart(self, one: list[gtsam.Pose3], other: list[gtsam.Pose3]) -> bool:
        """Return whether two paths of K key poses end in places that the lattice tells apart."""
        away = one[-1].translation() - other[-1].translation()
        return float(np.linalg.norm(away)) >= STEPS[0] * self._depth

    def density(self, poses: list[gtsam.Pose3], values: gtsam.Values) -> float:
        """Return how likely a solution is, in nats but for a constant.

        Parameters
        ----------
        poses
            K key poses.
        values
            The same, with what else odometry's factors are on.
        """
        readings = few_of(RelativeMotions.along(self.drive, poses).readings, len(poses))
        return self.agreement(readings, poses) - float(drive_graph(self.drive).error(values))

    def agreement(self, readings: KeyPoseReadings, poses: list[gtsam.Pose3]) -> float:
        """Return by how much readings are likelier in common tiles than with a tile for each visit.

        Parameters
        ----------
        readings
            Of the drive, all or some, which stand for all with less noise.
        poses
            K key poses.

        Returns
        -------
        In nats, of the tiles that the vehicle was in since ``begun`` and before.
        """
        anchoring, _ = anchored(poses, self.prior)
        owner, again = anchoring.tile[readings.key_pose], np.unique(anchoring.tile[self.begun :])
        visited = [
            number
            for number in again.tolist()
            if len(visits_among(readings.key_pose[owner == number])) > 1
        ]
        shared = readings[np.flatnonzero(np.isin(owner, visited))]
        share = len(readings) / len(self.drive.readings)
        tiles = occupied_tiles(anchoring, shared, poses, self.drive.sensors, self.prior)
        return sum(self._agreement(tile, shared.key_pose[tile.rows], share) for tile in tiles)

    def _agreement(self, tile: OccupiedTile, key_pose: IntArray, share: float) -> float:
        """Return by how much visits to one tile are likelier together."""
        x, sensor = tile.placed.x, tile.placed.readings.sensor
        variance = share * (self.noise[sensor, None] ** 2 + tile.field.unresolved(x))
        seen = Seen(x, tile.placed.field(self.drive.sensors), variance, key_pose)
        alone = [Remembered.of(tile.field, seen[rows]) for rows in visits_among(key_pose)]
        return reduce(add, alone).evidence - sum(each.evidence for each in alone)

    @property
    def _depth(self) -> float:
        """Depth of the stronger sources in metres: a field is linear over about as much."""
        known = self.prior.hyperparameters
        on_floor = known.floor_scale >= known.ceiling_scale
        return float(np.clip(known.floor_depth if on_floor else known.ceiling_depth, *DEPTH_M))


class Bending:
    """A path whose end is moved as odometry and scans allow.

    Parameters
    ----------
    drive
        K key poses.
    poses
        Where they are.
    known
        Number of the last one that stays there.
    """

    def __init__(self, drive: Drive, poses: list[gtsam.Pose3], known: int) -> None:
        self._values, self._last = drive_values(drive, poses), len(poses) - 1
        graph = drive_graph(drive)
        held = gtsam.noiseModel.Isotropic.Sigma(6, HELD)
        for k in range(known + 1):
            graph.add(gtsam.PriorFactorPose3(X(k), poses[k], held))
        self._linear, self._ordering = graph.linearize(self._values), colamd_ordering(graph)
        self._by_pose = np.hstack([np.zeros((3, 3)), poses[-1].rotation().matrix()])

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the last pose's place in the map, square metres, shape (3, 3)."""
        of_pose = Marginals(self._linear, self._ordering).of(X(self._last))
        return np.asarray(self._by_pose @ of_pose @ self._by_pose.T)

    def to(self, node: FloatArray) -> tuple[list[gtsam.Pose3], float]:
        """Return the likeliest path whose end is moved so in the map, and its cost in nats."""
        still, along = self._solutions
        delta = still
        for step, own in zip(node.tolist(), along, strict=True):
            delta = delta.add(own.scale(step))
        poses = poses_in(self._values.retract(delta), self._last + 1)
        return poses, self._linear.error(delta) - self._least

    @cached_property
    def _solutions(self) -> tuple[gtsam.VectorValues, list[gtsam.VectorValues]]:
        """The path whose end stays, and by what it bends for each metre of its end."""
        still = self._ending_at(np.zeros(3))
        return still, [self._ending_at(axis).subtract(still) for axis in np.eye(3)]

    def _ending_at(self, node: FloatArray) -> gtsam.VectorValues:
        exact = gtsam.noiseModel.Isotropic.Sigma(3, AT_NODE_M)
        bent = gtsam.GaussianFactorGraph()
        bent.push_back(self._linear)
        bent.add(gtsam.JacobianFactor(X(self._last), self._by_pose, node, exact))
        return bent.optimize(self._ordering)

    @cached_property
    def _least(self) -> float:
        return float(self._linear.error(self._linear.optimize(self._ordering)))


def few_of(readings: KeyPoseReadings, key_poses: int) -> KeyPoseReadings:
    """Return ``READINGS`` for each key pose, evenly spread; all where there are no more."""
    count = min(len(readings), READINGS * key_poses)
    return readings[np.linspace(0, len(readings) - 1, count).astype(np.int64)]


def nodes(covariance: FloatArray, depth: float) -> tuple[FloatArray, float]:
    """Return the nodes of a lattice over a Gaussian in space but its middle, likeliest first.

    Parameters
    ----------
    covariance
        Of the Gaussian, square metres, shape (3, 3).
    depth
        That ``STEPS`` are in, metres.

    Returns
    -------
    Nodes in metres, shape (n, 3), and the step of the lattice; none where the Gaussian is within a
    depth of its middle.
    """
    variance, axes = np.linalg.eigh(covariance)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    if SIGMAS * sigma.max() < depth:
        return np.empty((0, 3)), depth
    for step in depth * np.array(STEPS):
        count = np.minimum(SIGMAS * sigma / step, MOST_STEPS).astype(int)
        along = step * (np.indices(2 * count + 1).reshape(3, -1).T - count)
        squared = np.sum((along / np.maximum(sigma, step / SIGMAS)) ** 2, axis=1)
        order = np.argsort(squared, kind="stable")
        chosen = order[(squared[order] > 0) & (squared[order] <= SIGMAS**2)]
        if len(chosen) <= MOST_NODES:
            break
    return along[chosen[:MOST_NODES]] @ axes.T, float(step)

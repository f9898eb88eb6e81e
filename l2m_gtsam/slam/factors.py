"""The factors of a drive beside its readings: start, odometry, scans, calibrations."""

import gtsam
import numpy as np

from l2m_factors import D, G, T, X, held_directions, scaled_step_factor
from l2m_gtsam.data import FloatArray
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose, as_pose
from l2m_gtsam.slam.links import MAP, Links

EXACT = 1e-9  # m, uT, or of an entry of C: what no reading can tell from nothing
ROUNDING = 1e-9  # of a variance: smaller ones are those of a file's last digits


def start_factor(start: StartPose) -> gtsam.NonlinearFactor:
    """Return what is known of the first key pose."""
    noise = gtsam.noiseModel.Gaussian.Covariance(start.covariance)
    return gtsam.PriorFactorPose3(X(0), as_pose(start.T_map_lidar), noise)


def step_factor(drive: Drive, number: int, longer: float = 0.0) -> gtsam.NonlinearFactor:
    """Return what odometry says from a key pose to the next, if ways are longer by this share."""
    noise = gtsam.noiseModel.Gaussian.Covariance(drive.steps.covariance[number])
    return gtsam.BetweenFactorPose3(X(number), X(number + 1), drive.step(number, longer), noise)


def scaled_factor(drive: Drive, number: int) -> gtsam.NonlinearFactor:
    """Return the same where odometry's scale is a variable."""
    noise = gtsam.noiseModel.Gaussian.Covariance(drive.steps.covariance[number])
    return scaled_step_factor(number, drive.step(number), noise)


def link_pose(links: Links, number: int) -> gtsam.Pose3:
    """Return where a scan has a key pose, in the map or in the frame of an earlier one."""
    return gtsam.Pose3(gtsam.Rot3(links.R[number]), links.p[number])


def link_factor(links: Links, number: int) -> gtsam.NonlinearFactor:
    """Return what a scan says of a key pose."""
    noise = gtsam.noiseModel.Gaussian.Covariance(links.covariance[number])
    pose = link_pose(links, number)
    origin, key = int(links.origin[number]), X(int(links.key_pose[number]))
    if origin == MAP:
        return gtsam.PriorFactorPose3(key, pose, noise)
    return gtsam.BetweenFactorPose3(X(origin), key, pose, noise)


def link_graph(links: Links) -> gtsam.NonlinearFactorGraph:
    """Return what scans say."""
    graph = gtsam.NonlinearFactorGraph()
    for number in range(len(links)):
        graph.add(link_factor(links, number))
    return graph


def link_squared(links: Links, values: gtsam.Values) -> FloatArray:
    """Return the squared lengths of the whitened residuals of links, shape (L,)."""
    return np.array([2 * link_factor(links, n).error(values) for n in range(len(links))])


def calibration_graph(sensors: KnownSensors) -> gtsam.NonlinearFactorGraph:
    """Return what is known of sensors that are variables: their covariance as prior."""
    graph = gtsam.NonlinearFactorGraph()
    for i, covariance in enumerate(sensors.covariance):
        at = np.concatenate([sensors.t[i], sensors.distortion[i]])
        graph.add(held_directions(i, root_information(covariance), at))
    return graph


def root_information(covariance: FloatArray) -> FloatArray:
    """Return W with ``W S W^T = I``; what a file says is exact, or a little less, is nearly so."""
    sigma = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0.0)), EXACT)
    values, vectors = np.linalg.eigh(covariance / np.outer(sigma, sigma))
    return np.asarray((vectors / np.sqrt(np.maximum(values, ROUNDING))).T / sigma)


def calibration_values(sensors: KnownSensors) -> gtsam.Values:
    """Return sensors as values."""
    values = gtsam.Values()
    for i in range(len(sensors.names)):
        values.insert(T(i), sensors.t[i])
        values.insert(D(i), sensors.distortion[i])
    return values


def odometry_graph(drive: Drive) -> gtsam.NonlinearFactorGraph:
    """Return start and odometry."""
    graph, sigma = gtsam.NonlinearFactorGraph(), drive.steps.scale
    graph.add(start_factor(drive.start))
    one_step = scaled_factor if sigma else step_factor
    for number in range(len(drive.steps)):
        graph.add(one_step(drive, number))
    if sigma:
        known = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        graph.add(gtsam.PriorFactorDouble(G(), 0.0, known))
    return graph


def scale_values(drive: Drive) -> gtsam.Values:
    """Return odometry's scale as it is before anything is known of it, if it is a variable."""
    values = gtsam.Values()
    if drive.steps.scale:
        values.insert(G(), 0.0)
    return values

"""The factors of a drive beside its readings: start, odometry, calibrations."""

import gtsam
import numpy as np

from l2m_factors import D, T, X, held_directions
from l2m_gtsam.data import FloatArray
from l2m_gtsam.graph.slam.drive import Drive, KnownSensors, StartPose, as_pose

EXACT = 1e-9  # m, uT, or of an entry of C: what no reading can tell from nothing
ROUNDING = 1e-9  # of a variance: smaller ones are those of a file's last digits


def start_factor(start: StartPose) -> gtsam.NonlinearFactor:
    """Return what is known of the first key pose."""
    noise = gtsam.noiseModel.Gaussian.Covariance(start.covariance)
    return gtsam.PriorFactorPose3(X(0), as_pose(start.T_map_lidar), noise)


def step_factor(drive: Drive, number: int) -> gtsam.NonlinearFactor:
    """Return what odometry says from a key pose to the next."""
    noise = gtsam.noiseModel.Gaussian.Covariance(drive.steps.covariance[number])
    return gtsam.BetweenFactorPose3(X(number), X(number + 1), drive.step(number), noise)


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
    graph = gtsam.NonlinearFactorGraph()
    graph.add(start_factor(drive.start))
    for number in range(len(drive.steps)):
        graph.add(step_factor(drive, number))
    return graph

"""The pose graph of a drive: start, odometry, scan registrations, calibrations as factors.

A scan may be registered in a place that only looks like the right one. Which links are believed is
found by graduated non-convexity on the whole pose graph (GTSAM's ``GncLMOptimizer``; H. Yang,
P. Antonante, V. Tzoumas, L. Carlone, 2020), with start and odometry as known inliers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import gtsam
import numpy as np

from l2m_factors import (
    D,
    G,
    Residual,
    T,
    V,
    X,
    drifting_fixed_axes_step,
    drifting_step,
    fixed_axes_residual,
    fixed_axes_step_factor,
    held_directions,
    joint_residual,
    scaled_step_factor,
)
from l2m_gtsam.calibration.factor_graph import unit_priors
from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.slam.drift import DRIFT
from l2m_gtsam.slam.drive import Drive, KnownSensors, StartPose, as_pose
from l2m_gtsam.slam.links import MAP, Links
from l2m_gtsam.slam.map_prediction import poses_in
from l2m_gtsam.slam.solution import DriveSolution
from l2m_gtsam.solve.linear_algebra import information_root

EXACT = 1e-9  # m, uT, or of an entry of C: sigma of parameters that are stated as exact
ROUNDING = 1e-9  # of a variance: smaller ones are those of a file's last digits
# Successive key poses whose residuals in Python are one factor. Four iterations on 356 key poses
# with one tile take 0.76 s of a processor with 4 key poses in a factor, 0.70 with 8 and 0.73 with
# 16; with 347 weights instead of 108 the last stage takes 6.7, 6.6 and 7.0.
TOGETHER = 8
HALF = 0.5  # a link that weighs more is believed; in the end weights are nearly 0 or 1


def start_factor(start: StartPose) -> gtsam.NonlinearFactor:
    """Return the prior of the first key pose."""
    noise = gtsam.noiseModel.Gaussian.Covariance(start.covariance)
    return gtsam.PriorFactorPose3(X(0), as_pose(start.T_map_lidar), noise)


def between_factor(number: int, step: gtsam.Pose3, covariance: FloatArray) -> gtsam.NonlinearFactor:
    """Return the factor of a step from a key pose to the next, with its covariance, (6, 6)."""
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.BetweenFactorPose3(X(number), X(number + 1), step, noise)


def step_factor(drive: Drive, number: int) -> gtsam.NonlinearFactor:
    """Return odometry's factor from a key pose to the next."""
    noise = gtsam.noiseModel.Gaussian.Covariance(drive.steps.covariance[number])
    if drive.steps.fixed_axes is not None:
        turn, way = fixed_axes_step(drive, number, drive.steps.fixed_axes)
        return fixed_axes_step_factor(number, turn, way, noise)
    return between_factor(number, drive.step(number), drive.steps.covariance[number])


def step_errors(drive: Drive, poses: list[gtsam.Pose3], scale_error: float = 0.0) -> FloatArray:
    """Return by how much K poses differ from odometry's steps, as its factors count it, (K - 1, 6).

    Rotation in rad before translation in metres, in the frame of the next pose.
    """
    errors = np.empty((len(drive.steps), 6))
    for k in range(len(errors)):
        if drive.steps.fixed_axes is None:
            moved = poses[k].between(poses[k + 1])
            errors[k] = gtsam.Pose3.Logmap(drive.step(k, scale_error).between(moved))
        else:
            turn, way = fixed_axes_step(drive, k, drive.steps.fixed_axes)
            errors[k] = fixed_axes_residual(poses[k : k + 2], turn, (1 + scale_error) * way, None)
    return errors


def scaled_factor(drive: Drive, number: int) -> gtsam.NonlinearFactor:
    """Return the same with odometry's scale as a variable."""
    noise = gtsam.noiseModel.Gaussian.Covariance(drive.steps.covariance[number])
    return scaled_step_factor(number, drive.step(number), noise)


def drifting_residual(drive: Drive, number: int, weights: FloatArray) -> Residual:
    """Return the white residual of the same with odometry's steady drift as a variable."""
    noise = gtsam.noiseModel.Gaussian.Covariance(drive.steps.covariance[number])
    if drive.steps.fixed_axes is None:
        return drifting_step(number, drive.step(number), weights).whitened(noise)
    turn, way = fixed_axes_step(drive, number, drive.steps.fixed_axes)
    return drifting_fixed_axes_step(number, turn, way, weights).whitened(noise)


def fixed_axes_step(drive: Drive, number: int, ways: FloatArray) -> tuple[gtsam.Rot3, FloatArray]:
    """Return turn and way of a step along the axes of the map, of ways (K - 1, 3) by odometry."""
    start = drive.start.T_map_lidar.R
    turn = start @ drive.steps.fixed_turns[number] @ start.T
    return gtsam.Rot3(turn), np.asarray(start @ ways[number])


def link_pose(links: Links, number: int) -> gtsam.Pose3:
    """Return the measured pose of a link, in the map or relative to an earlier key pose."""
    return gtsam.Pose3(gtsam.Rot3(links.R[number]), links.p[number])


def link_factor(links: Links, number: int) -> gtsam.NonlinearFactor:
    """Return the factor of a scan registration."""
    noise = gtsam.noiseModel.Gaussian.Covariance(links.covariance[number])
    pose = link_pose(links, number)
    origin, key = int(links.origin[number]), X(int(links.key_pose[number]))
    if origin == MAP:
        return gtsam.PriorFactorPose3(key, pose, noise)
    return gtsam.BetweenFactorPose3(X(origin), key, pose, noise)


def link_graph(links: Links) -> gtsam.NonlinearFactorGraph:
    """Return the factors of all scan registrations."""
    graph = gtsam.NonlinearFactorGraph()
    for number in range(len(links)):
        graph.add(link_factor(links, number))
    return graph


def link_squared(links: Links, values: gtsam.Values) -> FloatArray:
    """Return the squared lengths of the whitened residuals of links, shape (L,)."""
    return np.array([2 * link_factor(links, n).error(values) for n in range(len(links))])


def calibration_graph(sensors: KnownSensors) -> gtsam.NonlinearFactorGraph:
    """Return the priors of calibrations that are variables."""
    graph = gtsam.NonlinearFactorGraph()
    for i, (at, covariance) in enumerate(zip(sensors.vectors(), sensors.covariance, strict=True)):
        graph.add(held_directions(i, stated_information_root(covariance), at))
    return graph


def stated_information_root(covariance: FloatArray) -> FloatArray:
    """Return W with ``W S W^T = I``; a file may state S as exact, or as slightly negative."""
    sigma = np.maximum(np.sqrt(np.maximum(np.diag(covariance), 0.0)), EXACT)
    return information_root(covariance, sigma, ROUNDING)


def calibration_values(sensors: KnownSensors) -> gtsam.Values:
    """Return sensors as values."""
    values = gtsam.Values()
    for i in range(len(sensors.names)):
        values.insert(T(i), sensors.t[i])
        values.insert(D(i), sensors.distortion[i])
    return values


def successive(key_poses: Sequence[int]) -> Iterator[list[int]]:
    """Yield the key poses, which ascend, whose residuals are one factor."""
    for _, together in groupby(key_poses, lambda k: k // TOGETHER):
        yield list(together)


def odometry_graph(drive: Drive) -> gtsam.NonlinearFactorGraph:
    """Return the factors of start and odometry."""
    graph, sigma, drifts = gtsam.NonlinearFactorGraph(), drive.steps.scale, drive.drifts
    graph.add(start_factor(drive.start))
    if drifts is not None:
        steps = [drifting_residual(drive, number, own) for number, own in enumerate(drifts)]
        for first in range(0, len(steps), TOGETHER):
            graph.add(joint_residual(steps[first : first + TOGETHER]).factor())
        graph.push_back(unit_priors({V(): DRIFT}))
        return graph
    one_step = scaled_factor if sigma else step_factor
    for number in range(len(drive.steps)):
        graph.add(one_step(drive, number))
    if sigma:
        known = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
        graph.add(gtsam.PriorFactorDouble(G(), 0.0, known))
    return graph


def shared_values(drive: Drive) -> gtsam.Values:
    """Return initial values of odometry's scale and steady drift, if they are variables."""
    values = gtsam.Values()
    if drive.steps.scale:
        values.insert(G(), 0.0)
    if drive.drifts is not None:
        values.insert(V(), np.zeros(DRIFT))
    return values


def drive_graph(drive: Drive) -> gtsam.NonlinearFactorGraph:
    """Return the factors of start, odometry and scans."""
    graph = odometry_graph(drive)
    graph.push_back(link_graph(drive.links))
    return graph


def drive_values(drive: Drive, poses: list[gtsam.Pose3]) -> gtsam.Values:
    """Return what these factors are on, at K key poses."""
    values = shared_values(drive)
    values.insert(pose_values(poses))
    return values


def pose_values(poses: list[gtsam.Pose3]) -> gtsam.Values:
    """Return K key poses as variables."""
    values = gtsam.Values()
    for k, pose in enumerate(poses):
        values.insert(X(k), pose)
    return values


def steady_drift(values: gtsam.Values) -> FloatArray | None:
    """Return odometry's steady drift in its standard deviations, shape (8,); None if it is none."""
    return np.asarray(values.atVector(V())) if values.exists(V()) else None


@dataclass(frozen=True)
class PoseGraph:
    """A drive solved by odometry and scans alone.

    Attributes
    ----------
    poses
        Estimates of the K key poses.
    believed
        Which links are inliers, shape (L,).
    """

    poses: list[gtsam.Pose3]
    believed: BoolArray


def solve_pose_graph(drive: Drive, confidence: float) -> PoseGraph:
    """Estimate key poses from odometry and links, and which links are inliers.

    Parameters
    ----------
    drive
        K key poses with odometry and L links; its readings are not used. What its steps share
        counts as none, and their axes as those of the vehicle; see ``Drive.as_walk``.
    confidence
        Share of links with only the stated errors that are believed.
    """
    poses = drive.dead_reckoning()
    if not len(drive.links):
        return PoseGraph(poses, np.empty(0, dtype=np.bool_))
    # The optimiser copies its factors, which GTSAM cannot do with those that are written in Python.
    plain = replace(drive.steps, scale=0.0, steady=None, turning=None, fixed_axes=None)
    graph = odometry_graph(replace(drive, steps=plain))
    sure = graph.size()
    graph.push_back(link_graph(drive.links))
    optimizer = gtsam.GncLMOptimizer(graph, pose_values(poses), _params(sure))
    optimizer.setInlierCostThresholdsAtProbability(confidence)
    found = poses_in(optimizer.optimize(), len(poses))
    believed = np.asarray(optimizer.getWeights())[sure:] > HALF
    return PoseGraph(found, believed)


def _params(sure: int) -> gtsam.GncLMParams:
    """Return settings with which so many first factors are taken for true."""
    params = gtsam.GncLMParams()
    # Truncated least squares: beyond its threshold a wrong link pulls no more (Yang, Antonante,
    # Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception", 2020).
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers(list(range(sure)))
    return params


def write_g2o(path: Path, solution: DriveSolution) -> None:
    """Write localised key poses as vertices and odometry as edges.

    The format knows no magnetic readings, no prior, no scale and no drift: lengths are corrected as
    they came out. Nor does it know steps along fixed axes: those along the vehicle's stand for
    them. Numbers have six digits, as GTSAM writes them.
    """
    graph = gtsam.NonlinearFactorGraph()
    drive = solution.drive.without_drift(solution.steady, solution.poses)
    for number in range(len(drive.steps)):
        step = drive.step(number, solution.scale_error)
        graph.add(between_factor(number, step, drive.steps.covariance[number]))
    gtsam.writeG2o(graph, pose_values(solution.poses), str(path))

"""What a smoothed drive says of its last key pose, field and sensor: where a filter goes on.

Errors of path and sensor have the covariance of the density without weights
(:mod:`.path_information`). The weights follow these to first order, and have their own covariance
on a given path beside it. The graph's own covariance would take the path for better known than the
field allows.
"""

from dataclasses import replace

import numpy as np

from l2m_factors import D, M, V
from l2m_gtsam.slam.online.belief import POSE
from l2m_gtsam.slam.solution import REJECTED_WEIGHT
from l2m_gtsam.slam.unknown_field.field_filter import FilterState
from l2m_gtsam.slam.unknown_field.path_information import PathNeighbourhood, determined
from l2m_gtsam.slam.unknown_field.smoothed_drive import SmoothedDrive, with_noise

# Sigmas of the ship's poses are 5 to 16 % larger than with 120, heights 26 %, in less than half the
# time.
VECTORS = 50
SENSOR = 15


def end_state(smooth: SmoothedDrive) -> FilterState:
    """Return what is known at the last key pose of a drive with one sensor.

    The pose is relative to the first, as the field is.
    """
    last = smooth.stage.last
    poses, values = last.poses, last.values
    drive = replace(smooth.drive, sensors=with_noise(last.sensors, smooth.noise))
    robust = np.maximum(last.weights, REJECTED_WEIGHT)
    near = PathNeighbourhood(drive, poses, values, smooth.prior, smooth.noise, robust)
    weights, K = values.atVector(M(0)), len(poses)
    of_path, pose = near.density.weights(weights, near.sensor), poses[0].between(poses[-1])
    m, distortion = len(weights), SENSOR - 3
    steady = values.atVector(V()) if values.exists(V()) else np.zeros(POSE)
    # Rows: relative pose, weights, distortion, drift.
    size = POSE + m + distortion + POSE
    by_poses, by_drift = np.zeros((size, K, POSE)), np.zeros((size, POSE))
    by_sensor = np.zeros((size, SENSOR))
    own, of_weights = np.arange(POSE), slice(POSE, POSE + m)
    by_poses[own, -1, own] = 1.0
    by_poses[:POSE, 0] = -pose.inverse().AdjointMap()
    by_poses[of_weights] = near.by_key_poses(of_path.by_path)
    by_sensor[of_weights] = of_path.by_sensor
    by_sensor[POSE + m : POSE + m + distortion, 3:] = np.eye(distortion)
    by_drift[size - POSE :] = np.eye(POSE)
    root = near.by_errors(by_poses, by_drift, by_sensor)
    taken = root @ determined(near, VECTORS)
    covariance = root @ root.T - taken @ taken.T
    covariance[of_weights, of_weights] += of_path.covariance
    if not values.exists(V()):
        covariance[size - POSE :, size - POSE :] = np.eye(POSE)
    return FilterState(pose, weights, values.atVector(D(0)).reshape(1, -1), steady, covariance, 0.0)

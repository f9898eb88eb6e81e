"""How wrong odometry becomes along a drive: covariances of its steps, and its steady drift."""

import numpy as np

from l2m_gtsam.data import FloatArray, Trajectory
from l2m_gtsam.geometry import isotropic_covariance, turn_angle
from l2m_gtsam.slam.options import DriftOptions

DRIFT = 8
"""Components of a steady drift: along three axes with time, with distance; turning with both."""
PLANAR = 1e-6  # metres and radians; a lidar or a gyroscope leaves a plane by more
PLANE = (
    "Odometry never leaves a plane: if the floor is as even and the vehicle does not rock, "
    "`slam.drift.height_share: 0` and `slam.drift.tilt_deg_per_m: 0` say so, and poses become "
    "better."
)


def plane_hints(
    trajectory: Trajectory, options: DriftOptions, *, is_stated: bool
) -> tuple[str, ...]:
    """Return what would help odometry without heights and tilts, where options let these drift.

    Nothing where the recording states how odometry errs: options do not count there.
    """
    if is_stated or options.height_share is not None or options.tilt_deg_per_m is not None:
        return ()
    is_plane = (
        np.ptp(trajectory.p[:, 2]) <= PLANAR and np.ptp(trajectory.R[:, 2], axis=0).max() <= PLANAR
    )
    return (PLANE,) if is_plane else ()


def steady_share(options: DriftOptions, *, is_stated: bool) -> FloatArray:
    """Return a steady drift's standard deviation along each axis as a share of the distance, (3,).

    All are 0 for none. Covariances that a recording states have what they share already.
    """
    if options.scale:
        return np.zeros(3)
    share = options.steady
    if share is None:
        share = 0.0 if is_stated else options.position_share
    return share * np.array([1.0, 1.0, options.of_height])


def steady_turn(options: DriftOptions) -> FloatArray:
    """Return the standard deviation of a steady turning in radians per metre, shape (1,)."""
    return np.deg2rad([options.steady_turn_deg_per_m])


def steady_weights(seconds: FloatArray, p: FloatArray, share: FloatArray) -> FloatArray:
    """Return what a steady drift by a share of the distance adds to N steps, shape (N, 2, d).

    Parameters
    ----------
    seconds, p
        Times and steps, shapes (N,) and (N, 3), metres.
    share
        Standard deviation of each of d components per metre of the whole drive, half of its
        variance with time, shape (d,).
    """
    length = np.linalg.norm(p, axis=1)
    speed = length.sum() / seconds.sum() if len(seconds) else 0.0
    both = np.column_stack([speed * seconds, length])
    return np.asarray(np.sqrt(0.5) * both[:, :, None] * share)


def drift_covariance(
    R: FloatArray, p: FloatArray, options: DriftOptions, up: FloatArray | None = None
) -> FloatArray:
    """Return covariances of N steps that grow with their length and rotation, shape (N, 6, 6).

    Parameters
    ----------
    R, p
        The steps, shapes (N, 3, 3) and (N, 3), metres.
    options
        Drift of odometry.
    up
        The third axis of the frame of the poses, in that of each step's end, shape (N, 3). Where it
        is not known, heights and tilts drift as all else does.
    """
    length, turn = np.linalg.norm(p, axis=1), turn_angle(R)
    # Steps err independently: variances add up to (share * over_m)^2 after over_m metres.
    over = options.over_m * length
    position = options.position_share**2 * over
    rotation = np.deg2rad(options.rotation_deg_per_m) ** 2 * over
    rotation += (options.rotation_share * turn) ** 2
    covariance = np.zeros((len(p), 6, 6))
    covariance[:, :3, :3] = rotation[:, None, None] * np.eye(3)
    covariance[:, 3:, 3:] = position[:, None, None] * np.eye(3)
    if up is not None:
        level = np.eye(3) - up[:, :, None] * up[:, None]
        covariance[:, :3, :3] += (rotation * (options.of_tilt**2 - 1))[:, None, None] * level
        covariance[:, 3:, 3:] = position[:, None, None] * stretched(up, options.of_height**2)
    return np.asarray(covariance + isotropic_covariance(options.least_deg, options.least_m))


def stretched(axes: FloatArray, ratio: float) -> FloatArray:
    """Return unit variances that are other by a ratio along one axis each, shape (N, 3, 3).

    Parameters
    ----------
    axes
        Unit vectors, shape (N, 3).
    ratio
        Of variances.
    """
    return np.asarray(np.eye(3) + (ratio - 1) * axes[:, :, None] * axes[:, None])

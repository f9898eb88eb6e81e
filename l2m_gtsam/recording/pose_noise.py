"""Covariances of the lidar's poses at any time of a drive, as square roots."""

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, IntArray, Trajectory
from l2m_gtsam.options import Options

ASSUMED_S = 1.0  # an error of a pose lasts so long where nothing is known of it


class PoseNoiseOptions(Options):
    """How wrong the poses are; what is not given here is taken from the recording's covariances."""

    position_m: float | None = Field(default=None, ge=0)
    """Standard deviation of the position per axis in metres, in place of what the recording
    says. If neither this nor `rotation_deg` is given and the recording states nothing, poses are
    taken as exact; if only one is given and the recording states nothing, the other is 0."""
    rotation_deg: float | None = Field(default=None, ge=0, le=45)
    """Standard deviation of the rotation about each axis in degrees, in the same way."""
    correlation_s: float | None = Field(default=None, ge=0)
    """How long an error lasts in seconds: the correlation of two errors falls to 1/e over this
    time. 0 means that every pose has an error of its own; readings between two have both's. If
    it is not given, a calibration finds it from what readings of different sensors share; it is
    1 second if they do not determine it."""

    @property
    def lasting_s(self) -> float:
        """How long an error is taken to last, if nothing else is known."""
        return ASSUMED_S if self.correlation_s is None else self.correlation_s

    def lasting(self, seconds: float) -> "PoseNoiseOptions":
        """Return the same with errors that last so long."""
        return self.model_copy(update={"correlation_s": seconds})


def pose_roots(
    trajectory: Trajectory, stamp_ns: IntArray, options: PoseNoiseOptions
) -> FloatArray | None:
    """Return square roots L of the covariances of the poses' errors, ``L @ L.T = covariance``.

    Covariances are interpolated linearly in time; before the first and after the last pose they
    are as there. The roots depend on the time alone, and change smoothly where covariances do,
    also where these are singular, so that ``L @ u`` with a u that lasts is an error that lasts.

    Parameters
    ----------
    trajectory
        Poses, with their covariances if these are known.
    stamp_ns
        Times in nanoseconds, shape (N,).
    options
        What is known otherwise.

    Returns
    -------
    Shape (N, 6, 6), rows in radians and metres in the order and axes of
    ``Trajectory.covariance``; None where no error is known of, or all are 0.
    """
    given = options.rotation_deg is not None and options.position_m is not None
    stated = None if given else _stated(trajectory, stamp_ns)
    covariance = np.zeros((1, 6, 6)) if stated is None else stated
    if options.rotation_deg is not None:
        _overrule(covariance, slice(0, 3), float(np.deg2rad(options.rotation_deg)))
    if options.position_m is not None:
        _overrule(covariance, slice(3, 6), options.position_m)
    if not covariance.any():
        return None
    roots = _roots(covariance, _scale(trajectory))
    return np.broadcast_to(roots, (len(stamp_ns), 6, 6))


def _stated(trajectory: Trajectory, stamp_ns: IntArray) -> FloatArray | None:
    """Return the recording's covariances at these times, shape (N, 6, 6)."""
    if trajectory.covariance is None:
        return None
    last = len(trajectory) - 1
    before = np.clip(np.searchsorted(trajectory.stamp_ns, stamp_ns, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    start = trajectory.stamp_ns[before]
    gap = np.maximum(trajectory.stamp_ns[after] - start, 1)  # 0 on the last pose
    share = np.clip((stamp_ns - start) / gap, 0.0, 1.0)[:, None, None]
    earlier, later = trajectory.covariance[before], trajectory.covariance[after]
    return np.asarray((1 - share) * earlier + share * later)


def _overrule(covariance: FloatArray, part: slice, sigma: float) -> None:
    """Set one half of covariances, shape (N, 6, 6), to an error of its own, in place."""
    covariance[:, part, :] = 0.0
    covariance[:, :, part] = 0.0
    covariance[:, part, part] = sigma**2 * np.eye(3)


def _scale(trajectory: Trajectory) -> FloatArray:
    """Return typical sizes of the six errors: one of rotations, one of positions, shape (6,).

    They belong to the whole drive, so that a time has the same root whichever times it is asked
    with.
    """
    if trajectory.covariance is None:
        return np.ones(6)
    variance = np.diagonal(trajectory.covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
    size = np.sqrt(variance.mean(axis=(0, 2)))
    return np.repeat(np.where(size > 0, size, 1.0), 3)


def _roots(covariance: FloatArray, scale: FloatArray) -> FloatArray:
    """Return the symmetric roots of scaled covariances, scaled back, shape (N, 6, 6).

    A Cholesky factor would jump where a singular covariance turns with the vehicle (an error
    about the map's vertical alone); the symmetric root does not.
    """
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    sizes = np.sqrt(np.maximum(values, 0.0))  # below 0 by rounding
    return np.asarray(scale[:, None] * ((vectors * sizes[:, None]) @ vectors.swapaxes(1, 2)))

"""Scans of solid boxes by the simulated LiDAR, without a scenario."""

import numpy as np

from l2m_gtsam.data import IntArray, Trajectory
from l2m_gtsam.simulate.lidar import PosesAt, RayCaster, SimulatedScans, SpinningLidarOptions
from l2m_gtsam.simulate.solids import Solids


def scans(
    solids: Solids,
    options: SpinningLidarOptions,
    poses_at: PosesAt,
    stamp_ns: IntArray,
    seed: int = 0,
) -> SimulatedScans:
    """Return the scans that begin at these stamps."""
    return SimulatedScans(RayCaster(solids), options, poses_at, stamp_ns, seed)


def snapshots(
    solids: Solids, options: SpinningLidarOptions, trajectory: Trajectory, seed: int = 0
) -> SimulatedScans:
    """Return a scan without sweep at every pose of a trajectory."""
    still = options.model_copy(update={"sweep": 0.0})

    def poses_at(stamp_ns: IntArray) -> Trajectory:
        row = np.searchsorted(trajectory.stamp_ns, stamp_ns)
        R, p = trajectory.R[row], trajectory.p[row]
        return Trajectory(stamp_ns, R, p, trajectory.frame, trajectory.child_frame)

    return scans(solids, still, poses_at, trajectory.stamp_ns, seed)

"""The scans that a loop matcher keeps as plain arrays, and back."""

import numpy as np

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.slam.online.loop_matcher import KeptScan, LoopMatcher
from l2m_gtsam.slam.online.packing import Arrays


def packed_loops(matcher: LoopMatcher) -> Arrays:
    """Return what a matcher remembers as arrays."""
    kept = matcher.kept
    points = [np.empty((0, 3), dtype=np.float32), *(each.points for each in kept)]
    return {
        "path_m": np.array([matcher.path_m, matcher.last_m]),
        "key_pose": np.array([each.key_pose for each in kept], dtype=np.int64),
        "stamp_ns": np.array([each.stamp_ns for each in kept], dtype=np.int64),
        "scan_path_m": np.array([each.path_m for each in kept], dtype=np.float64),
        "R_key_scan": np.reshape([each.T_key_scan.R for each in kept], (-1, 3, 3)),
        "t_key_scan": np.reshape([each.T_key_scan.t for each in kept], (-1, 3)),
        "points": np.concatenate(points),
        "count": np.array([len(each.points) for each in kept], dtype=np.int64),
    }


def resume_loops(matcher: LoopMatcher, arrays: Arrays) -> None:
    """Give a matcher what another one remembered."""
    points = np.split(arrays["points"], np.cumsum(arrays["count"]))[:-1]
    columns = (
        arrays["key_pose"].tolist(),
        map(RigidTransform, arrays["R_key_scan"], arrays["t_key_scan"]),
        arrays["stamp_ns"].tolist(),
        points,
        arrays["scan_path_m"].tolist(),
    )
    kept = [KeptScan(*each) for each in zip(*columns, strict=True)]
    path_m, last_m = arrays["path_m"].tolist()
    matcher.resume(kept, path_m, last_m)

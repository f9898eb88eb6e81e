"""The scans that a loop matcher keeps as plain arrays, and back."""

import numpy as np

from l2m_gtsam.data import RigidTransform
from l2m_gtsam.lidar.loop_closures import KeyScan
from l2m_gtsam.slam.online.loop_matcher import KeptScan, LoopMatcher
from l2m_gtsam.slam.online.packing import Arrays

TRANSFORMS = ("R_key_scan", "t_key_scan", "R_map_scan", "t_map_scan")


def packed_loops(matcher: LoopMatcher) -> Arrays:
    """Return what a matcher remembers as arrays."""
    kept = matcher.kept
    points = [np.empty((0, 3), dtype=np.float32), *(each.scan.points for each in kept)]
    return {
        "path_m": np.array([matcher.path_m, matcher.last_m]),
        "key_pose": np.array([each.key_pose for each in kept], dtype=np.int64),
        "stamp_ns": np.array([each.scan.stamp_ns for each in kept], dtype=np.int64),
        "scan_path_m": np.array([each.scan.path_m for each in kept], dtype=np.float64),
        "R_key_scan": np.reshape([each.T_key_scan.R for each in kept], (-1, 3, 3)),
        "t_key_scan": np.reshape([each.T_key_scan.t for each in kept], (-1, 3)),
        "R_map_scan": np.reshape([each.scan.T.R for each in kept], (-1, 3, 3)),
        "t_map_scan": np.reshape([each.scan.T.t for each in kept], (-1, 3)),
        "points": np.concatenate(points),
        "count": np.array([len(each.scan.points) for each in kept], dtype=np.int64),
    }


def resume_loops(matcher: LoopMatcher, arrays: Arrays) -> None:
    """Give a matcher what another one remembered."""
    ends = np.cumsum(arrays["count"])[:-1]
    columns = (arrays[name] for name in ("key_pose", "stamp_ns", "scan_path_m", *TRANSFORMS))
    kept = [
        KeptScan(
            int(key_pose),
            RigidTransform(R_key_scan, t_key_scan),
            KeyScan(int(stamp), points, RigidTransform(R_map_scan, t_map_scan), float(path)),
        )
        for key_pose, stamp, path, R_key_scan, t_key_scan, R_map_scan, t_map_scan, points in zip(
            *columns, np.split(arrays["points"], ends), strict=False
        )
    ]
    path_m, last_m = arrays["path_m"].tolist()
    matcher.resume(kept, path_m, last_m)

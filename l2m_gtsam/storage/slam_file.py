"""``slam.json``: how a localisation ended, in figures, and the covariance of every pose."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.slam_results import LocalisationResult, SensorUse, StartCandidate, StartSearch
from l2m_gtsam.storage.atomic import atomic_path
from l2m_gtsam.storage.calibration_file import source_entry

FORMAT = "l2m-slam"
VERSION = 1
LEGEND = {
    "poses": "T_map_lidar at key poses: stamp_ns, p in metres, quaternion_xyzw",
    "covariance": "of a right perturbation, T_true = T_map_lidar Exp(error): rotation (rad), then "
    "translation (m), along the axes of the lidar",
    "drift": "odometry alone, from where the drive is said to begin, less the localised poses",
    "chi2_per_dof": "mean square of whitened residuals; 1 is consistent",
    "start": "where the drive may have begun, looked for all over the map, the likeliest first; "
    "margin: natural logarithm of how much likelier the first is than the second, null without one",
}


def write_slam(path: Path, result: LocalisationResult, options: dict[str, Any]) -> None:
    """Write a localisation with the options that made it.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    content = {
        "format": FORMAT,
        "version": VERSION,
        "legend": LEGEND,
        "status": result.status.value,
        "message": result.message,
        "notes": list(result.notes),
        "drift": {**asdict(result.drift), "end_share": result.drift.end_share},
        "sensors": {each.sensor: _use_entry(each) for each in result.sensors},
        "bag": source_entry(result.bag),
        "map": source_entry(result.map),
        "calibration": source_entry(result.calibration_source),
        "start": None if result.start is None else start_entry(result.start),
        "poses": _pose_entries(result),
        "options": options,
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, allow_nan=False), encoding="utf-8")


def start_entry(search: StartSearch) -> dict[str, Any]:
    """Return a search for the start as plain values."""
    return {
        "verdict": search.verdict.value,
        "message": search.message,
        "margin": search.margin if np.isfinite(search.margin) else None,
        "window_m": search.window_m,
        "readings": search.readings,
        "looked_at": search.looked_at,
        "candidates": [_candidate_entry(each) for each in search.candidates],
    }


def _candidate_entry(candidate: StartCandidate) -> dict[str, Any]:
    pose = candidate.T_map_lidar
    return {
        "p": pose.t.tolist(),
        "quaternion_xyzw": Rotation.from_matrix(pose.R).as_quat().tolist(),
        "covariance": candidate.covariance.tolist(),
        "log_likelihood": candidate.log_likelihood,
        "inside": candidate.inside,
        "explained": candidate.explained,
        "chi2_per_dof": candidate.chi2_per_dof,
    }


def _use_entry(use: SensorUse) -> dict[str, Any]:
    numbers = {**asdict(use), "used": use.used}
    del numbers["sensor"]
    return {name: value if np.isfinite(value) else None for name, value in numbers.items()}


def _pose_entries(result: LocalisationResult) -> list[dict[str, Any]]:
    at, covariance = result.trajectory, result.trajectory.covariance
    quaternions = Rotation.from_matrix(at.R).as_quat()
    return [
        {
            "stamp_ns": int(stamp),
            "p": p.tolist(),
            "quaternion_xyzw": q.tolist(),
            "covariance": None if covariance is None else covariance[k].tolist(),
        }
        for k, (stamp, p, q) in enumerate(zip(at.stamp_ns, at.p, quaternions, strict=True))
    ]

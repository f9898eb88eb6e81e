"""What a drive showed a sensor: directions of the field, headings, heights."""

import numpy as np
from scipy.spatial import cKDTree

from l2m_gtsam.data import FloatArray, Recording, Trajectory
from l2m_gtsam.qa.metrics.evidence import SensorEvidence
from l2m_gtsam.qa.metrics.plain import evenly, row, rows
from l2m_gtsam.records.metrics import Directions, DriveMetrics

SPHERE = 400  # directions, about 10 degrees apart
NEAR_DEG = 15.0
HEADING_DEG = 15.0
PATH = 800


def directions(evidence: SensorEvidence) -> Directions:
    """Return from which directions the field came, as the map has it along the lidar's axes."""
    b = evidence.b_lidar[evidence.used]
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    away, _ = cKDTree(unit).query(sphere(SPHERE))
    elevation = np.rad2deg(np.arcsin(np.clip(unit[:, 2], -1, 1)))
    # Singular values of centred rows over sqrt(N): standard deviations along principal axes.
    spread = np.linalg.svd(b - b.mean(axis=0), compute_uv=False) / np.sqrt(len(b))
    return Directions(
        covered=float(np.mean(away < 2 * np.sin(np.deg2rad(NEAR_DEG) / 2))),
        spread=row(spread, 4),
        tilt_deg=float(np.ptp(elevation)),
    )


def sphere(count: int) -> FloatArray:
    """Return directions spread evenly over all of space, shape (count, 3): a golden spiral."""
    # Equal steps of z cut a sphere into zones of equal area (Archimedes); the golden angle keeps
    # neighbours of successive turns apart.
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    r = np.sqrt(1 - z**2)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def drive_metrics(recording: Recording) -> DriveMetrics:
    """Return how the vehicle moved, in all drives of a recording together."""
    drives = [each.trajectory for each in recording.parts]
    p, R = (np.concatenate(each) for each in ([d.p for d in drives], [d.R for d in drives]))
    up = R[:, :, 2]
    mean = up.mean(axis=0) / np.linalg.norm(up.mean(axis=0))
    tilt = np.arccos(np.clip(up @ mean, -1, 1))
    heading = np.arctan2(R[:, 1, 0], R[:, 0, 0])
    sector = np.floor(np.rad2deg(heading) % 360 / HEADING_DEG)
    return DriveMetrics(
        path=rows(_path(drives), 3),
        seconds=float(sum(1e-9 * (d.stamp_ns[-1] - d.stamp_ns[0]) for d in drives)),
        length=float(sum(np.linalg.norm(np.diff(d.p, axis=0), axis=1).sum() for d in drives)),
        heave=float(np.ptp(p[:, 2])),
        tilt_deg=float(np.rad2deg(tilt.max())),
        heading=float(len(np.unique(sector)) / (360 / HEADING_DEG)),
    )


def _path(drives: list[Trajectory]) -> FloatArray:
    """Return places of the lidar, thinned, with a row of NaN between two drives."""
    most, parts = PATH // len(drives), []
    for drive in drives:
        parts += [np.full((1, 3), np.nan), drive.p[evenly(len(drive), most)]]
    return np.concatenate(parts[1:])

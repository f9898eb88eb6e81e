"""Where on a cloud a drive begins, when nobody says: places along the mapping drives are tried."""

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, LidarMap, RigidTransform
from l2m_gtsam.errors import LidarError
from l2m_gtsam.geometry import difference
from l2m_gtsam.lidar.registration import Registration, RegistrationOptions, register
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.options import Options

# Points of the scan that rank the candidates.
FEW_POINTS = 400


class SearchOptions(Options):
    """How the first scan is found on a cloud."""

    headings: int = Field(default=12, ge=1, le=360)
    """Headings that are tried at each place, evenly around the vertical."""
    tried: int = Field(default=30, ge=1)
    """How many of the candidates that fit best are registered."""
    lead: float = Field(default=0.05, ge=0, le=1)
    """The start is ambiguous if another place has a share of inliers less than this below that of
    the best."""
    apart_m: float = Field(default=1.0, gt=0)
    """Another place is further away than this, metres,"""
    apart_deg: float = Field(default=20.0, gt=0)
    """or turned by more than this."""


def find_start(
    scan: Surface,
    cloud: Surface,
    mapped: LidarMap,
    options: SearchOptions,
    registration: RegistrationOptions,
) -> RigidTransform:
    """Return where a scan was taken, near any place that the mapping drives passed.

    Parameters
    ----------
    scan
        In the lidar frame, thinned.
    cloud
        Of the map.
    mapped
        Its mapping drives' poses.
    options
        What is tried.
    registration
        What is believed.

    Raises
    ------
    LidarError
        The scan fits nowhere, or at several places.
    """
    found: list[Registration] = [
        result
        for guess in _best(scan, cloud, _candidates(mapped, options), options)
        if (result := register(scan, cloud, guess, registration)).refusal(registration) is None
    ]
    if not found:
        raise LidarError(
            f"the first scan fits nowhere along the mapping drives ({len(mapped.p)} places were "
            "tried): is it another place? Else say with `lidar.start` where the drive begins"
        )
    found.sort(key=lambda each: each.share, reverse=True)
    best = found[0]
    others = [each for each in found[1:] if _is_elsewhere(best.T, each.T, options)]
    if others and others[0].share > best.share - options.lead:
        places = " and ".join(_place(each.T) for each in (best, others[0]))
        raise LidarError(
            f"the first scan fits at several places, {places}; say with `lidar.start` where the "
            "drive begins"
        )
    return best.T


def _candidates(mapped: LidarMap, options: SearchOptions) -> list[RigidTransform]:
    """Return the mapped poses, each turned about the vertical."""
    angles = 2 * np.pi * np.arange(options.headings) / options.headings
    turns = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    poses = zip(mapped.R, mapped.p, strict=True)
    return [RigidTransform(turn @ R, p) for R, p in poses for turn in turns]


def _best(
    scan: Surface, cloud: Surface, candidates: list[RigidTransform], options: SearchOptions
) -> list[RigidTransform]:
    """Return the candidates whose points are nearest to the cloud."""
    if not (scan.usable and cloud.usable):
        return []
    points = scan.points[:: max(1, len(scan) // FEW_POINTS)]
    away = [_away(points, cloud, each) for each in candidates]
    return [candidates[k] for k in np.argsort(away)[: options.tried]]


def _away(points: FloatArray, cloud: Surface, T: RigidTransform) -> float:
    """Return the mean distance to the cloud, metres, of which a metre is as bad as many."""
    _, distance = cloud.nearest(points @ T.R.T + T.t)
    return float(np.minimum(distance, 1.0).mean())


def _is_elsewhere(T: RigidTransform, other: RigidTransform, options: SearchOptions) -> bool:
    off = difference(T, other)
    turned = np.rad2deg(np.linalg.norm(off[:3])) > options.apart_deg
    return bool(np.linalg.norm(off[3:]) > options.apart_m or turned)


def _place(found: RigidTransform) -> str:
    x, y, z = found.t
    heading = np.rad2deg(np.arctan2(found.R[1, 0], found.R[0, 0]))
    return f"({x:.1f}, {y:.1f}, {z:.1f}) m heading {heading:.0f} degrees"

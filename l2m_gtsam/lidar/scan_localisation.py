"""Scans localised on the cloud that was saved with a map, and the search for the first of them."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, LidarMap, RigidTransform, Trajectory
from l2m_gtsam.errors import LidarError
from l2m_gtsam.geometry import compose, difference, isotropic_covariance, moved
from l2m_gtsam.lidar.odometry import CHILD_FRAME, ScanStep
from l2m_gtsam.lidar.registration import (
    PoseEstimate,
    Refusal,
    Registration,
    RegistrationOptions,
    by_scan,
    combined,
    register,
)
from l2m_gtsam.lidar.surface import Surface
from l2m_gtsam.options import AnyQuaternion, Options
from l2m_gtsam.records.scans import PoseFix

# Points of the scan that rank the candidates.
FEW_POINTS = 400
# Along what a scan does not show a fix says nothing, nor do some hundreds of them; more than this
# beside the millimetres of what it shows would drown in rounding.
UNSEEN = {"unseen_m": 100.0, "unseen_deg": 100.0}


class ScanStartOptions(Options):
    """Where the lidar is at the first scan."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the map in metres; within `localisation.registration.reach_m` of the truth."""
    quaternion_xyzw: AnyQuaternion = (0.0, 0.0, 0.0, 1.0)
    """Rotation from lidar to map, of any length but zero; within about 15 degrees."""

    def rigid(self) -> RigidTransform:
        """Return the pose."""
        R = Rotation.from_quat(self.quaternion_xyzw).as_matrix()
        return RigidTransform(R, np.array(self.position))


class ScanLocalisationOptions(Options):
    """How scans are localised on a cloud."""

    registration: RegistrationOptions = RegistrationOptions()
    """How each is registered, and when it is refused."""
    cloud_m: float = Field(default=0.005, ge=0)
    """How wrong the cloud itself is, as a standard deviation of the position in metres that
    neighbouring poses share: it bends with the errors of the mapping drive's poses,"""
    cloud_deg: float = Field(default=0.05, ge=0)
    """and of the rotation in degrees."""
    cloud_over_m: float = Field(default=5.0, gt=0)
    """Path length over which the cloud's errors are the same."""

    def beside_odometry(self) -> "ScanLocalisationOptions":
        """Return options with which a fix says nothing along what its scan does not show."""
        registration = self.registration.model_copy(update=UNSEEN)
        return self.model_copy(update={"registration": registration})

    def of_cloud(self) -> FloatArray:
        """Return the covariance that the cloud's errors add to a pose, shape (6, 6)."""
        return isotropic_covariance(self.cloud_deg, self.cloud_m)


@dataclass(frozen=True)
class ScanLocalisation:
    """Where scans were taken.

    Attributes
    ----------
    fixes
        Pose of each believed scan by itself.
    trajectory
        Their poses by scans and odometry together; scans that were refused have none.
    refused
        How many scans were refused, by reason.
    """

    fixes: tuple[PoseFix, ...]
    trajectory: Trajectory
    refused: dict[Refusal, int]

    @property
    def scans(self) -> int:
        """How many scans there were."""
        return len(self.fixes) + sum(self.refused.values())


def localise_scans(
    steps: Iterable[ScanStep],
    cloud: Surface,
    start: PoseEstimate,
    options: ScanLocalisationOptions,
    frame: str = "map",
) -> ScanLocalisation:
    """Register scan after scan on a cloud, each from where odometry expects it.

    Along what a scan shows, its pose is that of the registration; along the rest, that of odometry
    from the scan before, and the covariance grows until a scan determines it again.

    Parameters
    ----------
    steps
        Scans with odometry, in order of time.
    cloud
        In the map frame.
    start
        The lidar in the map at the first scan, and how well that is known.
    options
        How, and when a scan is refused.
    frame
        Name of the map frame.

    Raises
    ------
    LidarError
        There are no scans, or the first does not fit the cloud at the start.
    """
    fixes, poses, refused = list[PoseFix](), list[PoseEstimate](), Counter[Refusal]()
    last: PoseEstimate | None = None
    for step in steps:
        expected = start if last is None else _expected(last, step)
        found = register(step.surface, cloud, expected.T, options.registration)
        refusal = found.refusal(options.registration)
        if refusal is not None and last is None:
            raise LidarError(_not_at_start(start.T, found, refusal, options.registration))
        if refusal is not None:
            refused[refusal] += 1
            last = expected
            continue
        fix = by_scan(found, expected.T, options.registration)
        last = combined(found, expected, options.registration)
        fixes.append(PoseFix(step.stamp_ns, fix.T, fix.covariance + options.of_cloud()))
        poses.append(last)
    if not fixes:
        raise LidarError("no scan has points enough to be localised")
    trajectory = Trajectory(
        np.array([each.stamp_ns for each in fixes], dtype=np.int64),
        np.array([each.T.R for each in poses]),
        np.array([each.T.t for each in poses]),
        frame,
        CHILD_FRAME,
        np.array([each.covariance for each in poses]) + options.of_cloud(),
    )
    return ScanLocalisation(tuple(fixes), trajectory, dict(refused))


def spaced(
    fixes: tuple[PoseFix, ...], apart_m: float, options: ScanLocalisationOptions
) -> tuple[PoseFix, ...]:
    """Return fixes whose errors may count as independent.

    One is kept per ``apart_m`` metres of path. n fixes that share an error of the cloud get n times
    its covariance, so that together they know it no better than one of them without noise.

    Parameters
    ----------
    fixes
        In order of time, each with the cloud's errors once.
    apart_m
        Metres.
    options
        That they were made with.
    """
    kept = list(fixes[:1])
    for fix in fixes[1:]:
        if np.linalg.norm(fix.T_map_lidar.t - kept[-1].T_map_lidar.t) >= apart_m:
            kept.append(fix)
    places = np.reshape([each.T_map_lidar.t for each in kept], (-1, 3))
    path = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))
    half = options.cloud_over_m / 2
    near = np.searchsorted(path, path + half, side="right") - np.searchsorted(path, path - half)
    more = options.of_cloud()
    return tuple(
        replace(each, covariance=each.covariance + (count - 1) * more)
        for each, count in zip(kept, near.tolist(), strict=False)
    )


def _expected(last: PoseEstimate, step: ScanStep) -> PoseEstimate:
    covariance = moved(last.covariance[None], step.step)[0] + step.covariance
    return PoseEstimate(compose(last.T, step.step), covariance)


def _not_at_start(
    start: RigidTransform, found: Registration, refusal: Refusal, options: RegistrationOptions
) -> str:
    x, y, z = start.t
    return (
        f"the first scan does not fit the map's cloud at ({x:g}, {y:g}, {z:g}) m: {refusal} "
        f"({found.share:.0%}, at least {options.least_share:.0%} is required, determining "
        f"{found.directions} of 6 directions); set `lidar.start` to where the drive begins, or "
        "is it another place?"
    )


class ScanSearchOptions(Options):
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
    options: ScanSearchOptions,
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
            "tried): is it another place? Else set `lidar.start` to where the drive begins"
        )
    found.sort(key=lambda each: each.share, reverse=True)
    best = found[0]
    others = [each for each in found[1:] if _is_elsewhere(best.T, each.T, options)]
    if others and others[0].share > best.share - options.lead:
        places = " and ".join(_place(each.T) for each in (best, others[0]))
        raise LidarError(
            f"the first scan fits at several places, {places}; set `lidar.start` to where the "
            "drive begins"
        )
    return best.T


def _candidates(mapped: LidarMap, options: ScanSearchOptions) -> list[RigidTransform]:
    """Return the mapped poses, each turned about the vertical."""
    angles = 2 * np.pi * np.arange(options.headings) / options.headings
    turns = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    poses = zip(mapped.R, mapped.p, strict=True)
    return [RigidTransform(turn @ R, p) for R, p in poses for turn in turns]


def _best(
    scan: Surface, cloud: Surface, candidates: list[RigidTransform], options: ScanSearchOptions
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


def _is_elsewhere(T: RigidTransform, other: RigidTransform, options: ScanSearchOptions) -> bool:
    off = difference(T, other)
    turned = np.rad2deg(np.linalg.norm(off[:3])) > options.apart_deg
    return bool(np.linalg.norm(off[3:]) > options.apart_m or turned)


def _place(found: RigidTransform) -> str:
    x, y, z = found.t
    heading = np.rad2deg(np.arctan2(found.R[1, 0], found.R[0, 0]))
    return f"({x:.1f}, {y:.1f}, {z:.1f}) m heading {heading:.0f} degrees"

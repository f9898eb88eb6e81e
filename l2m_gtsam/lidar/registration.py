"""A scan registered on a surface, how well that determines its pose, and whether it is true."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.geometry import as_matrix, difference, from_matrix, isotropic_covariance, perturbed
from l2m_gtsam.lidar.surface import (
    Planes,
    Surface,
    distances,
    inflated,
    library,
    plane_information,
    plane_step,
)
from l2m_gtsam.options import Options

# Steps smaller than this end a registration: far below any error of it.
STEP_RAD, STEP_M = 1e-4, 1e-4
MAX_ITERATIONS = 30
# How far generalised ICP is off on single scans of a hall: measured 2 mrad and 5 mm.
GICP_RAD, GICP_M = 2e-3, 5e-3
REFINEMENTS = 2
FEWEST = 6
# Distances beyond so many standard deviations are of other things.
GATE = 3.0
LEAST_SIGMA_M = 1e-3


class RegistrationOptions(Options):
    """How a scan is registered, and what is asked of it."""

    edge: float = Field(default=0.25, ge=0.01)
    """Scans are thinned to a point per cell of this size in metres."""
    reach_m: float = Field(default=1.0, gt=0)
    """Points are matched over this distance first, metres: so far off may the start be,"""
    match_m: float = Field(default=0.3, gt=0)
    """and over this distance in the end."""
    inlier_m: float = Field(default=0.1, gt=0)
    """A point lies on the surface if its plane is nearer than this, metres."""
    least_share: float = Field(default=0.8, gt=0, le=1)
    """A registration is refused if a smaller share of the scan's points lies on the surface: floor
    and ceiling, and a wall or two, fit nearly everywhere;"""
    least_directions: int = Field(default=3, ge=1, le=6)
    """or if the scan determines fewer of the six directions of a pose."""
    unseen_m: float = Field(default=10.0, gt=0)
    """Standard deviation of the position in metres along what the scan does not show,"""
    unseen_deg: float = Field(default=30.0, gt=0)
    """and of the rotation in degrees."""
    floor_m: float = Field(default=0.001, ge=0)
    """No position is claimed to be better than this, metres: motion within a scan, the lidar's own
    calibration and bends of the surface are not in the misfit."""
    floor_deg: float = Field(default=0.01, ge=0)
    """The same for rotations, degrees."""


class Refusal(StrEnum):
    """Why a registration is not believed."""

    FEW_POINTS = "the scan has too few points"
    ELSEWHERE = "too few of its points lie on the surface"
    UNDETERMINED = "it shows too little to determine a pose"


@dataclass(frozen=True)
class Registration:
    """A scan on a surface.

    Attributes
    ----------
    T
        The lidar in the frame of the surface, as the match has it: along what the scan does not
        show, it means nothing.
    information
        Of a right perturbation, rotation before translation, shape (6, 6); singular where the
        scan does not determine a direction.
    share
        Of the scan's points that lie on the surface.
    rms
        Of their distances to its planes in metres.
    directions
        How many of the six directions of the pose are determined.
    """

    T: RigidTransform
    information: FloatArray
    share: float
    rms: float
    directions: int

    def refusal(self, options: RegistrationOptions) -> Refusal | None:
        """Return why this is not believed, or nothing if it is."""
        if not self.share:
            return Refusal.FEW_POINTS
        if self.share < options.least_share:
            return Refusal.ELSEWHERE
        if self.directions < options.least_directions:
            return Refusal.UNDETERMINED
        return None


@dataclass(frozen=True)
class PoseEstimate:
    """A pose and the covariance of its right perturbation, shape (6, 6)."""

    T: RigidTransform
    covariance: FloatArray


def register(
    scan: Surface, surface: Surface, guess: RigidTransform, options: RegistrationOptions
) -> Registration:
    """Register a scan, from a guess that is off by less than ``reach_m``.

    Generalised ICP takes a ring of a lidar on the floor for a plane, which tilts a scan by a tenth
    of a degree. So its result is refined on what are planes for certain, as far as these hold it.

    Parameters
    ----------
    scan
        In the lidar frame, thinned.
    surface
        What it is registered on.
    guess
        The lidar in the frame of the surface.
    options
        How.
    """
    if not (scan.usable and surface.usable):
        return Registration(guess, np.zeros((6, 6)), 0.0, np.inf, 0)
    T = guess
    for reach in (options.reach_m, options.match_m):
        T = _aligned(scan, surface, T, reach)
    for _ in range(REFINEMENTS):
        T = _refined(scan, surface, T, options)
    return _judged(scan, surface, T, options)


def combined(
    found: Registration, expected: PoseEstimate, options: RegistrationOptions
) -> PoseEstimate:
    """Return the pose that a registration and an expectation of it give together.

    The scan decides along what it shows, the expectation along the rest.
    """
    seen = inflated(found.information, isotropic_covariance(options.floor_deg, options.floor_m))
    # Around the registered pose, in whose axes the information is.
    turn = np.kron(np.eye(2), found.T.R.T @ expected.T.R)
    known = np.linalg.inv(turn @ expected.covariance @ turn.T)
    covariance = np.linalg.inv(seen + known)
    covariance = (covariance + covariance.T) / 2
    step = covariance @ known @ difference(found.T, expected.T)
    return PoseEstimate(perturbed(found.T, step), covariance)


def by_scan(
    found: Registration, guess: RigidTransform, options: RegistrationOptions
) -> PoseEstimate:
    """Return the pose that a registration gives, and the guess along what it does not show."""
    return combined(found, PoseEstimate(guess, unseen_covariance(options)), options)


def unseen_covariance(options: RegistrationOptions) -> FloatArray:
    """Return the covariance of a pose that a scan does not determine, shape (6, 6)."""
    return isotropic_covariance(options.unseen_deg, options.unseen_m)


def _aligned(
    scan: Surface, surface: Surface, guess: RigidTransform, reach: float
) -> RigidTransform:
    result = library("small_gicp").align(
        surface.cloud,
        scan.cloud,
        surface.tree,
        as_matrix(guess),
        "GICP",
        max_correspondence_distance=reach,
        max_iterations=MAX_ITERATIONS,
        rotation_epsilon=STEP_RAD,
        translation_epsilon=STEP_M,
    )
    return from_matrix(result.T_target_source)


@dataclass(frozen=True)
class _Matched:
    """Points of a scan, shape (n, 3), the planes that they lie on, and the share that does.

    ``rms`` is of their distances in metres; infinite where there are too few.
    """

    points: FloatArray
    planes: Planes
    share: float
    rms: float

    @property
    def enough(self) -> bool:
        return bool(np.isfinite(self.rms))

    def information(self, T: RigidTransform) -> FloatArray:
        return plane_information(self.points, T, self.planes, max(self.rms, LEAST_SIGMA_M))


def _matched(
    scan: Surface, surface: Surface, T: RigidTransform, options: RegistrationOptions
) -> _Matched:
    """Return the planes at the scan's points."""
    rows, away = surface.nearest(scan.points @ T.R.T + T.t)
    near = np.flatnonzero(away <= options.match_m)
    planes = surface.planes(rows[near])
    off = np.abs(distances(scan.points[near], T, planes))
    inlier = off <= options.inlier_m
    share = float(np.sum(inlier)) / len(scan)
    flat = inlier & planes.flat
    if np.sum(flat) < FEWEST:
        none = near[:0]
        return _Matched(scan.points[none], planes[none], share, np.inf)
    spread = 1.4826 * float(np.median(off[flat]))
    used = np.flatnonzero(flat & (off <= GATE * max(spread, LEAST_SIGMA_M)))
    rms = float(np.sqrt(np.mean(off[used] ** 2)))
    return _Matched(scan.points[near[used]], planes[used], share, rms)


def _refined(
    scan: Surface, surface: Surface, T: RigidTransform, options: RegistrationOptions
) -> RigidTransform:
    """Return a pose moved towards its planes, weighted against the accuracy of generalised ICP."""
    matched = _matched(scan, surface, T, options)
    if not matched.enough:
        return T
    information = matched.information(T)
    before: FloatArray = np.diag(1 / np.square(np.repeat([GICP_RAD, GICP_M], 3)))
    step = plane_step(matched.points, T, matched.planes)
    moved = np.linalg.solve(information + before, information @ step)
    return perturbed(T, np.asarray(moved, dtype=np.float64))


def _judged(
    scan: Surface, surface: Surface, T: RigidTransform, options: RegistrationOptions
) -> Registration:
    """Return a pose with what the planes at the scan's points say of it."""
    matched = _matched(scan, surface, T, options)
    if not matched.enough:
        return Registration(T, np.zeros((6, 6)), matched.share, np.inf, 0)
    information = matched.information(T)
    return Registration(T, information, matched.share, matched.rms, _directions(information))


def _directions(information: FloatArray) -> int:
    """Return the rank of information, whatever the units of its rows."""
    size = np.sqrt(np.maximum(np.diagonal(information), np.finfo(float).tiny))
    return int(np.linalg.matrix_rank(information / np.outer(size, size), tol=1e-9, hermitian=True))

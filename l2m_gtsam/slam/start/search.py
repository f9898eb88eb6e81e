"""Global search for the start of a drive in a map, from its first metres alone.

All positions and headings of a lattice are screened; those that readings do not rule out are
refined to local minima, and the likelihoods of the best of these are compared. While several of
them explain the readings, or none, the window is made longer.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.start.global_start import spread_out
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.errors import MapError
from l2m_gtsam.geometry import isotropic_covariance
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.localisation import StartCandidate, StartSearch, StartVerdict
from l2m_gtsam.slam.drive import Drive, StartPose
from l2m_gtsam.slam.options import SlamOptions, StartPoseOptions, StartSearchOptions
from l2m_gtsam.slam.start.likelihood import StartPrior, WindowFit
from l2m_gtsam.slam.start.refinement import PatternPoses, refined_poses
from l2m_gtsam.slam.start.screening import FieldLattice, StartHypotheses, lattice_over, screen
from l2m_gtsam.slam.start.window import DriveWindow, Pattern, window_of

MOST_NAMED = 4  # candidates in a message
ELSEWHERE = "another place, a start outside of the map, or a wrong calibration"
REMEDY = "a longer drive, one that turns, or `slam.start.position` and `quaternion_xyzw` settle it"
STRIDE = 1.5  # steps of the lattice: places nearer to a better one are not followed
SMALLEST = 0.5  # metres: least radius of the circle of headings
FIRST_STEPS, LAST_STEPS = 4, 12  # iterations of all, and of those that are continued
GO_ON = 5  # continued ones for each candidate
GROWTH = 2.0  # of a window
SIGMAS = 3.0  # inflation of the start's covariance: its readings are used again for the drive


def search_result(
    candidates: tuple[StartCandidate, ...],
    window: DriveWindow,
    looked_at: int,
    options: StartSearchOptions,
) -> StartSearch:
    """Return the result of a search from its candidates, the likeliest first.

    Parameters
    ----------
    candidates
        Distinct poses.
    window
        N readings that were compared.
    looked_at
        Number of hypotheses that were screened.
    options
        Conditions of a unique start.
    """
    margin = margin_of(candidates)
    verdict, message = verdict_of(candidates, margin, options)
    if verdict is StartVerdict.UNIQUE and len(window) < options.least_readings:
        verdict = StartVerdict.AMBIGUOUS
        least = options.least_readings
        message = f"{len(window)} readings do not determine a place, {least} may: {REMEDY}"
    summary = f"over the first {window.path_m:.1f} m of the drive {message}"
    return StartSearch(verdict, summary, margin, window.path_m, len(window), looked_at, candidates)


def nothing_read(window: DriveWindow) -> StartSearch:
    """Return the result of a search that has no readings to compare with the map."""
    message = (
        f"there are no readings over the first {window.path_m:.1f} m of the drive: begin the drive "
        "where the sensors send, or give `slam.start.position` and `quaternion_xyzw`"
    )
    return StartSearch(StartVerdict.AMBIGUOUS, message, 0.0, window.path_m, 0, 0, ())


def verdict_of(
    candidates: tuple[StartCandidate, ...], margin: float, options: StartSearchOptions
) -> tuple[StartVerdict, str]:
    """Return the verdict and the reason for it."""
    if not candidates:
        return StartVerdict.NOT_HERE, f"no place of the map explains the readings: {ELSEWHERE}"
    best = candidates[0]
    if not explains(best, options):
        message = (
            f"no place of the map explains the readings: at the best, {named(best)}, it has data "
            f"for {best.inside:.0%} of them, explains {best.explained:.0%} of these and leaves "
            f"{best.chi2_per_dof:.1f} times the variance of their errors: {ELSEWHERE}"
        )
        return StartVerdict.NOT_HERE, message
    if margin < options.clear:
        rivals = [each for each in candidates if likelier(best, each) < options.clear]
        message = (
            f"{len(rivals)} places of the map or more explain the readings: {listed(rivals)}; the "
            f"first is likelier by exp({margin:.1f}), exp({options.clear:g}) is required: {REMEDY}"
        )
        return StartVerdict.AMBIGUOUS, message
    away, turn = sigmas(best)
    if away > options.apart_m or turn > options.apart_deg:
        message = (
            f"the start is known within {away:.2f} m and {turn:.0f} deg only, about {named(best)}: "
            f"{REMEDY}"
        )
        return StartVerdict.AMBIGUOUS, message
    return StartVerdict.UNIQUE, f"one place explains the readings: {named(best)}"


def explains(candidate: StartCandidate, options: StartSearchOptions) -> bool:
    """Return whether a candidate explains the readings."""
    fits = candidate.chi2_per_dof <= options.largest_chi2
    inside = candidate.inside >= options.least_inside
    return fits and inside and candidate.explained >= options.least_explained


def margin_of(candidates: tuple[StartCandidate, ...]) -> float:
    """Return the log-likelihood ratio of the first two candidates."""
    if len(candidates) < 2:
        return float("inf")
    return likelier(candidates[0], candidates[1])


def likelier(best: StartCandidate, other: StartCandidate) -> float:
    """Return the log-likelihood ratio, over the best one's chi-square where that is above 1."""
    return (best.log_likelihood - other.log_likelihood) / max(best.chi2_per_dof, 1.0)


def sigmas(candidate: StartCandidate) -> tuple[float, float]:
    """Return the largest standard deviations of position in metres and rotation in degrees."""
    turn, away = (
        float(np.sqrt(np.linalg.eigvalsh(candidate.covariance[at, at]).max()))
        for at in (slice(0, 3), slice(3, 6))
    )
    return away, float(np.rad2deg(turn))


def listed(candidates: list[StartCandidate]) -> str:
    """Return the places of some candidates, the rest as a number."""
    text = ", ".join(named(each) for each in candidates[:MOST_NAMED])
    more = len(candidates) - MOST_NAMED
    return f"{text} and {more} more" if more > 0 else text


def named(candidate: StartCandidate) -> str:
    """Return where a candidate is."""
    x, y, z = candidate.T_map_lidar.t
    return f"({x:.2f}, {y:.2f}, {z:.2f}) m heading {candidate.yaw_deg:.0f} deg"


def find_start(
    drive: Drive, field_map: QueryableMap, options: SlamOptions, progress: Progress
) -> StartSearch:
    """Search a whole map for the start of a drive.

    Parameters
    ----------
    drive
        K key poses with odometry; of its start only the vertical counts.
    field_map
        Map with the readings that it was made of.
    options
        Those of `start` and `robust`.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    MapError
        The map has no survey, or is too large for the lattice.
    """
    if not isinstance(field_map, Surveyed):
        raise MapError("the map does not state where it has data: give the start of the drive")
    search = options.start.search
    progress("searching for the start", 0.0)
    lattice = lattice_over(field_map, field_map.readings, search.step_m)
    window_m = min(search.window_m, search.longest_m)
    while True:
        window = window_of(drive, window_m, search.readings)
        found = search_window(window, lattice, field_map, options)
        progress("searching for the start", min(window_m / search.longest_m, 1.0))
        last = window_m >= search.longest_m or len(window.p) == len(drive)
        if last or found.verdict is StartVerdict.UNIQUE:
            return found
        window_m = min(GROWTH * window_m, search.longest_m)


def start_found(found: StartSearch, options: StartPoseOptions) -> StartPose:
    """Return the start that a search found.

    Raises
    ------
    MapError
        Several places fit, or none.
    """
    if found.verdict is not StartVerdict.UNIQUE:
        raise MapError(found.message)
    best = found.candidates[0]
    least = isotropic_covariance(options.rotation_deg, options.position_m)
    return StartPose(best.T_map_lidar, SIGMAS**2 * best.covariance + least)


def search_window(
    window: DriveWindow, lattice: FieldLattice, field_map: QueryableMap, options: SlamOptions
) -> StartSearch:
    """Return the candidates of one window of a drive, with a verdict."""
    if not len(window):
        return nothing_read(window)
    search, known = options.start.search, start_prior(window, lattice, options)
    pattern = window.pattern(known.tilt)
    rises = pattern.origin[2] - window.p_odom_lidar[2] + known.height
    slack = SIGMAS * known.height_m
    nodes = lattice.between(rises - slack, rises + slack)
    screening = screen(pattern, lattice, nodes, search)
    ends = refined_minima(screening.places, pattern, field_map, search)
    fit = WindowFit(window, field_map, known)
    fits = [fit.at(pose) for pose in poses_of(ends, pattern, window)]
    return search_result(distinct(fits, search), window, screening.looked_at, search)


def start_prior(window: DriveWindow, lattice: FieldLattice, options: SlamOptions) -> StartPrior:
    """Return the prior of the first key pose."""
    start, height = options.start, options.start.search.height_m
    z = lattice.places(np.arange(len(lattice)))[:, 2]
    anywhere = float(np.ptp(z)) + 2.0 * lattice.step
    return StartPrior(
        up=window.R_odom_lidar[2],
        tilt=float(np.deg2rad(start.rotation_deg)),
        height=float(z.mean()) if height is None else height,
        height_m=anywhere if height is None else start.position_m,
        spread=lattice.spread,
        largest=options.robust.largest,
    )


def refined_minima(
    places: StartHypotheses, pattern: Pattern, field_map: QueryableMap, options: StartSearchOptions
) -> PatternPoses:
    """Return the best local minima that hypotheses lead to."""
    seeds, step = PatternPoses.upright(places), options.step_m
    if not len(seeds):
        return seeds
    seeds = keep_distinct(seeds, pattern, STRIDE * step, options.seeds)
    some = refined_poses(seeds, pattern, field_map, step, FIRST_STEPS)
    # Dozens of descents end in one basin: they must not crowd out its rivals.
    some = keep_distinct(some, pattern, options.apart_m, GO_ON * options.candidates)
    ends = refined_poses(some, pattern, field_map, step, LAST_STEPS)
    return keep_distinct(ends, pattern, options.apart_m, options.candidates)


def keep_distinct(poses: PatternPoses, pattern: Pattern, metres: float, most: int) -> PatternPoses:
    """Return the first poses that are at least so far from all kept before."""
    return poses[np.array(spread_out(as_points(poses, pattern), metres, most), dtype=np.int64)]


def as_points(poses: PatternPoses, pattern: Pattern) -> FloatArray:
    """Return poses as points in metres, shape (S, 5): headings lie on the pattern's circle."""
    return np.hstack([poses.p, max(pattern.radius, SMALLEST) * poses.R[:, :2, 0]])


def poses_of(poses: PatternPoses, pattern: Pattern, window: DriveWindow) -> list[RigidTransform]:
    """Return the first key pose in the map for poses of the pattern."""
    lever = window.p_odom_lidar - pattern.origin
    R, p = poses.R @ window.R_odom_lidar, poses.R @ lever + poses.p
    return [RigidTransform(*each) for each in zip(R, p, strict=True)]


def distinct(
    fits: Sequence[StartCandidate], options: StartSearchOptions
) -> tuple[StartCandidate, ...]:
    """Return distinct candidates, the likeliest first."""
    kept: list[StartCandidate] = []
    for fit in sorted(fits, key=lambda each: -each.log_likelihood):
        if all(are_apart(fit, other, options) for other in kept):
            kept.append(fit)
    return tuple(kept)


def are_apart(one: StartCandidate, other: StartCandidate, options: StartSearchOptions) -> bool:
    """Return whether two candidates are distinct."""
    a, b = one.T_map_lidar, other.T_map_lidar
    turn = np.rad2deg(Rotation.from_matrix(a.R.T @ b.R).magnitude())
    return bool(np.linalg.norm(a.t - b.t) > options.apart_m or turn > options.apart_deg)

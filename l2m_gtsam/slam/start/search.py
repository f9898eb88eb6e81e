"""Where a drive begins, without a guess: its first metres are laid over the whole map.

All places and headings of a lattice are screened; those that readings do not rule out are followed
to their minima, and the likelihoods of the best of these are compared. As long as two of them, or
none, explain the readings, more of the drive is looked at.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from l2m_gtsam.calibration.start.global_start import spread_out
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, RigidTransform
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.progress import Progress
from l2m_gtsam.records.localisation import StartCandidate, StartSearch, StartVerdict
from l2m_gtsam.slam.drive import Drive, StartPose
from l2m_gtsam.slam.options import SlamOptions, StartPoseOptions
from l2m_gtsam.slam.start.descent import Laid, descended
from l2m_gtsam.slam.start.field_lattice import FieldLattice, lattice_over
from l2m_gtsam.slam.start.fit import WindowFit
from l2m_gtsam.slam.start.options import StartSearchOptions
from l2m_gtsam.slam.start.prior import Beforehand
from l2m_gtsam.slam.start.screen import Places, screen
from l2m_gtsam.slam.start.verdict import judged
from l2m_gtsam.slam.start.window import Pattern, Window, window_of

STRIDE = 1.5  # steps of the lattice: places nearer to a better one are not followed
SMALLEST = 0.5  # metres: of the circle of headings
FIRST_STEPS, LAST_STEPS = 4, 12  # of all descents, and of those that go on
GO_ON = 5  # of them for each candidate
GROWTH = 2.0  # of a window
SIGMAS = 3.0  # of a start that was found: its readings are going to be used once more


def find_start(
    drive: Drive, field_map: QueryableMap, options: SlamOptions, progress: Progress
) -> StartSearch:
    """Look all over a map for where a drive begins.

    Parameters
    ----------
    drive
        The drive; of its start only what is up counts.
    field_map
        The map.
    options
        How to look.
    progress
        Called with a stage and the fraction of it that is done.

    Raises
    ------
    MapError
        The map does not tell where it was surveyed, or is too large for the lattice.
    """
    if not isinstance(field_map, Surveyed):
        raise MapError("the map does not tell where it has data: give the start of the drive")
    search = options.start.search
    progress("looking for the start", 0.0)
    lattice = lattice_over(field_map, field_map.readings, search.step_m)
    window_m = min(search.window_m, search.longest_m)
    while True:
        window = window_of(drive, window_m, search.readings)
        found = search_window(window, lattice, field_map, options)
        progress("looking for the start", min(window_m / search.longest_m, 1.0))
        last = window_m >= search.longest_m or len(window.p) == len(drive)
        if last or found.verdict is StartVerdict.UNIQUE:
            return found
        window_m = min(GROWTH * window_m, search.longest_m)


def start_found(found: StartSearch, options: StartPoseOptions) -> StartPose:
    """Return the start that a search found.

    Raises
    ------
    MapError
        It is not the only one, or there is none.
    """
    if found.verdict is not StartVerdict.UNIQUE:
        raise MapError(found.message)
    best = found.candidates[0]
    sigma = np.repeat([np.deg2rad(options.rotation_deg), options.position_m], 3)
    return StartPose(best.T_map_lidar, SIGMAS**2 * best.covariance + np.diag(sigma**2))


def search_window(
    window: Window, lattice: FieldLattice, field_map: QueryableMap, options: SlamOptions
) -> StartSearch:
    """Return where in a map a window of a drive fits."""
    search, known = options.start.search, beforehand(window, lattice, options)
    pattern = window.pattern(known.tilt)
    rises = pattern.origin[2] - window.p_odom_lidar[2] + known.height
    slack = SIGMAS * known.height_m
    nodes = lattice.between(rises - slack, rises + slack)
    screened = screen(pattern, lattice, nodes, search)
    ends = followed(screened.places, pattern, field_map, search)
    fit = WindowFit(window, field_map, known)
    fits = [fit.at(pose) for pose in poses_of(ends, pattern, window)]
    return judged(distinct(fits, search), window, screened.looked_at, search)


def beforehand(window: Window, lattice: FieldLattice, options: SlamOptions) -> Beforehand:
    """Return what is known of the start without readings."""
    start, height = options.start, options.start.search.height_m
    z = lattice.places(np.arange(len(lattice)))[:, 2]
    anywhere = float(np.ptp(z)) + 2.0 * lattice.step
    return Beforehand(
        up=window.R_odom_lidar[2],
        tilt=float(np.deg2rad(start.rotation_deg)),
        height=float(z.mean()) if height is None else height,
        height_m=anywhere if height is None else start.position_m,
        spread=lattice.spread,
        largest=options.robust.largest,
    )


def followed(
    places: Places, pattern: Pattern, field_map: QueryableMap, options: StartSearchOptions
) -> Laid:
    """Return the best minima that places lead to."""
    seeds, step = Laid.upright(places), options.step_m
    if not len(seeds):
        return seeds
    seeds = apart(seeds, pattern, STRIDE * step, options.seeds)
    some = descended(seeds, pattern, field_map, step, FIRST_STEPS)
    # Descents into one basin, which come in dozens, must not crowd out its rivals.
    some = apart(some, pattern, options.apart_m, GO_ON * options.candidates)
    ends = descended(some, pattern, field_map, step, LAST_STEPS)
    return apart(ends, pattern, options.apart_m, options.candidates)


def apart(laid: Laid, pattern: Pattern, metres: float, most: int) -> Laid:
    """Return the first poses that keep a distance from those before."""
    return laid[np.array(spread_out(drawn(laid, pattern), metres, most), dtype=np.int64)]


def drawn(laid: Laid, pattern: Pattern) -> FloatArray:
    """Return poses as points in metres, shape (S, 5): headings lie on a circle of the pattern."""
    return np.hstack([laid.p, max(pattern.radius, SMALLEST) * laid.R[:, :2, 0]])


def poses_of(laid: Laid, pattern: Pattern, window: Window) -> list[RigidTransform]:
    """Return where the first key pose is if the pattern lies at these poses."""
    lever = window.p_odom_lidar - pattern.origin
    R, p = laid.R @ window.R_odom_lidar, laid.R @ lever + laid.p
    return [RigidTransform(*each) for each in zip(R, p, strict=True)]


def distinct(
    fits: Sequence[StartCandidate], options: StartSearchOptions
) -> tuple[StartCandidate, ...]:
    """Return candidates that are apart, the likeliest first."""
    kept: list[StartCandidate] = []
    for fit in sorted(fits, key=lambda each: -each.log_likelihood):
        if all(are_apart(fit, other, options) for other in kept):
            kept.append(fit)
    return tuple(kept)


def are_apart(one: StartCandidate, other: StartCandidate, options: StartSearchOptions) -> bool:
    """Return whether two candidates are two places."""
    a, b = one.T_map_lidar, other.T_map_lidar
    turn = np.rad2deg(Rotation.from_matrix(a.R.T @ b.R).magnitude())
    return bool(np.linalg.norm(a.t - b.t) > options.apart_m or turn > options.apart_deg)

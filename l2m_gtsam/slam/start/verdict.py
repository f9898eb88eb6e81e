"""What a search for the start of a drive came to."""

import numpy as np

from l2m_gtsam.records.localisation import StartCandidate, StartSearch, StartVerdict
from l2m_gtsam.slam.start.options import StartSearchOptions
from l2m_gtsam.slam.start.window import Window

MOST_NAMED = 4  # candidates in a message
REMEDY = (
    "a longer drive, one that turns, or `slam.start.position` and `quaternion_xyzw` tell them apart"
)


def judged(
    candidates: tuple[StartCandidate, ...],
    window: Window,
    looked_at: int,
    options: StartSearchOptions,
) -> StartSearch:
    """Return what candidates, the likeliest first, come to.

    Parameters
    ----------
    candidates
        Places that are apart.
    window
        What was looked at.
    looked_at
        Places of the lattice.
    options
        What is asked of a unique one.
    """
    margin = margin_of(candidates)
    verdict, message = verdict_of(candidates, margin, options)
    if verdict is StartVerdict.UNIQUE and len(window) < options.least_readings:
        verdict = StartVerdict.AMBIGUOUS
        message = f"{len(window)} readings tell no place, {options.least_readings} may: {REMEDY}"
    told = f"over the first {window.way_m:.1f} m of the drive {message}"
    return StartSearch(verdict, told, candidates, margin, window.way_m, len(window), looked_at)


def verdict_of(
    candidates: tuple[StartCandidate, ...], margin: float, options: StartSearchOptions
) -> tuple[StartVerdict, str]:
    """Return the verdict and the reason for it."""
    if not candidates:
        return StartVerdict.NOT_HERE, f"no place of the map explains the readings: {elsewhere()}"
    best = candidates[0]
    if not explains(best, options):
        message = (
            f"no place of the map explains the readings: at the best, {named(best)}, it has data "
            f"for {best.inside:.0%} of them, explains {best.explained:.0%} of these and leaves "
            f"{best.chi2_per_dof:.1f} times the variance of their errors: {elsewhere()}"
        )
        return StartVerdict.NOT_HERE, message
    if margin < options.clear:
        rivals = [each for each in candidates if likelier(best, each) < options.clear]
        message = (
            f"{len(rivals)} places of the map or more explain the readings: {listed(rivals)}; the "
            f"first is likelier by exp({margin:.1f}), exp({options.clear:g}) is asked for: {REMEDY}"
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


def elsewhere() -> str:
    """Return what may be the reason that nothing fits."""
    return "another place, a start outside of the map, or a wrong calibration"


def explains(candidate: StartCandidate, options: StartSearchOptions) -> bool:
    """Return whether a candidate can be where the drive was."""
    fits = candidate.chi2_per_dof <= options.largest_chi2
    inside = candidate.inside >= options.least_inside
    return fits and inside and candidate.explained >= options.least_explained


def margin_of(candidates: tuple[StartCandidate, ...]) -> float:
    """Return by what natural logarithm the first is likelier than the second."""
    if len(candidates) < 2:
        return float("inf")
    return likelier(candidates[0], candidates[1])


def likelier(best: StartCandidate, other: StartCandidate) -> float:
    """Return by what logarithm one is likelier: less where it leaves more than noise."""
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

"""What changed at the places of a drive, in plain sentences."""

import numpy as np

from l2m_gtsam.records.places import Cause, CauseGain, ChangedSource

CAUSES = {
    Cause.PLACE: "the place changed",
    Cause.MOMENT: "something was there for one passage only",
    Cause.VEHICLE: "something on the vehicle was switched or moved",
    Cause.SENSOR: "one sensor changed",
}


def source_sentence(source: ChangedSource) -> str:
    """Return where steel came, went or was moved, how large it is, and what else it may be."""
    x, y, z = source.position
    spread = float(np.linalg.norm(source.position_sigma))
    moment, sigma = np.linalg.norm(source.moment), np.linalg.norm(source.moment_sigma)
    half = float(np.linalg.norm(source.half_axis))
    length = f", {2 * half:.1f} m long" if half else ""
    return (
        f"Steel came, went or was moved since the map was surveyed: at ({x:.1f}, {y:.1f}, {z:.1f}) "
        f"± {spread:.2f} m on the map{length}, with a moment of {moment:.2g} ± {sigma:.1g} A m². "
        f"It adds up to {source.strongest:.2g} µT to the readings, {source.nearest:.1f} m from the "
        f"nearest. It is taken into account. {cause_sentence(source)}"
    )


def cause_sentence(source: ChangedSource) -> str:
    """Return what the change is of; two that explain the readings about as well are both named."""
    if not source.explanations:
        return ""
    best, *others = source.explanations
    if source.cause is not None or not others:
        return f"The readings say that {CAUSES[best.cause]}."
    return f"It cannot be told whether {CAUSES[best.cause]} or {CAUSES[others[0].cause]}."


def best_of(explanations: tuple[CauseGain, ...]) -> str:
    """Return the causes with what they explain, the best first, as a phrase."""
    return ", ".join(f"{CAUSES[each.cause]} ({each.gain:.0f})" for each in explanations)

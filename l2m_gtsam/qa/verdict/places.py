"""What changed at the places of a drive, in plain sentences."""

import numpy as np

from l2m_gtsam.records.calibration import Disagreement, Return
from l2m_gtsam.records.places import Cause, CauseGain, ChangedSource
from l2m_gtsam.records.verdict import Level, Reason
from l2m_gtsam.text import sigma_alone, significant, vector_by_sigma, with_sigma

CAUSES = {
    Cause.PLACE: "the place changed",
    Cause.MOMENT: "something was there for one passage only",
    Cause.VEHICLE: "something on the vehicle was switched or moved",
    Cause.SENSOR: "one sensor changed",
}

SHORT = {
    Cause.PLACE: "the place",
    Cause.MOMENT: "one passage",
    Cause.VEHICLE: "the vehicle",
    Cause.SENSOR: "one sensor",
}


def cause_in_short(source: ChangedSource) -> str:
    """Return what the change is of in a few words, for a column."""
    if not source.explanations:
        return "-"
    best, *others = source.explanations
    if source.cause is not None or not others:
        return SHORT[best.cause]
    return f"{SHORT[best.cause]} or {SHORT[others[0].cause]}"


def place_of(source: ChangedSource) -> str:
    """Return where the change is in metres, with one standard deviation over all axes."""
    spread = float(np.linalg.norm(source.position_sigma))
    return f"{vector_by_sigma(source.position, (spread,) * 3)} ± {sigma_alone(spread)}"


def source_sentence(number: int, source: ChangedSource) -> str:
    """Return where steel came, went or was moved, how large it is, and what else it may be."""
    moment = float(np.linalg.norm(source.moment))
    sigma = float(np.linalg.norm(source.moment_sigma))
    length = f", {source.length_m:.1f} m long" if source.length_m else ""
    sentence = (
        f"Steel {number} came, went or was moved since the map was surveyed: at "
        f"{place_of(source)} m{length}, {with_sigma(moment, sigma, 'A m²')}, "
        f"up to {significant(source.strongest, 2)} µT at the readings. It is taken into account."
    )
    return sentence if source.cause is Cause.PLACE else f"{sentence} {cause_sentence(source)}"


def cause_sentence(source: ChangedSource) -> str:
    """Return what the change is of; two that explain the readings about as well are both named."""
    if not source.explanations:
        return ""
    best, *others = source.explanations
    if source.cause is not None or not others:
        return f"The readings say that {CAUSES[best.cause]}."
    return f"The readings do not show whether {CAUSES[best.cause]} or {CAUSES[others[0].cause]}."


PASSED = {
    Return.NEVER: "The environment has changed, or something passed by",
    Return.AS_MAPPED: "Something passed by",
    Return.DIFFERS: "The environment has changed since it was mapped",
}
DIFFERS = {
    Cause.PLACE: "The environment has changed since it was mapped",
    Cause.MOMENT: "Something passed by",
    Cause.VEHICLE: "Something on the vehicle was switched or moved",
    Cause.SENSOR: "Something at one sensor was switched or moved",
}
SEEN = {
    Return.NEVER: "It was not passed again",
    Return.AS_MAPPED: "Passed again the place was as mapped",
    Return.DIFFERS: "Passed again it differed, too",
}


def is_explained(stretch: Disagreement) -> bool:
    """Return whether any cause explains more of a stretch than its parameters do by chance."""
    return any(each.gain > 0 for each in stretch.explanations)


def stretch_head(stretch: Disagreement) -> str:
    """Return what a stretch of rejected readings is of; two that are about as likely are named."""
    if not is_explained(stretch):
        return PASSED[stretch.passed_again]
    best, *others = (DIFFERS[each.cause] for each in stretch.explanations)
    if stretch.cause is not None or not others:
        return best
    return f"{best}, or {others[0][0].lower()}{others[0][1:]}"


def stretch_tail(stretch: Disagreement) -> str:
    """Return what supports it: what each cause explains, or what another passage found."""
    if is_explained(stretch):
        return f"What explains all readings there: {best_of(stretch.explanations)}"
    return SEEN[stretch.passed_again]


def best_of(explanations: tuple[CauseGain, ...]) -> str:
    """Return the causes with what they explain, the best first, as a phrase."""
    return ", ".join(f"{CAUSES[each.cause]} ({each.gain:.0f})" for each in explanations)


def source_reasons(sources: tuple[ChangedSource, ...]) -> list[Reason]:
    """Return a warning for each source; numbers are those of the report."""
    return [Reason(Level.WARN, source_sentence(k, each)) for k, each in enumerate(sources, 1)]

"""Whether both halves of a drive tell the same."""

from l2m_gtsam.metric_results import Halves
from l2m_gtsam.qa.metrics.misfit import halves_agree
from l2m_gtsam.qa.reasons.reason import Case, Level, Reason, level_of
from l2m_gtsam.results import SensorStatus

# What a solve that ended otherwise says of its halves says nothing of the mounting.
JUDGED = (SensorStatus.SOLVED, SensorStatus.CONTRADICTED, SensorStatus.NOT_CONVERGED)


def repeat(case: Case) -> list[Reason]:
    """Return by how much both halves differ, where they do."""
    if case.metrics is None or case.sensor.status not in JUDGED:
        return []
    halves, options = case.metrics.halves, case.options
    if halves_agree(halves, options):
        return []
    level = level_of(halves.distance, options.halves_sigmas)
    return [Reason(*_meaning(case, level, _difference(halves)))]


def _difference(halves: Halves) -> str:
    t = ", ".join(f"{1e3 * each:.0f}" for each in halves.difference[:3])
    H = ", ".join(f"{each:.1f}" for each in halves.difference[12:])
    return (
        f"calibrated on both halves of the drive it differs by ({t}) mm in place, "
        f"{halves.turned_deg:.1f}° in rotation and ({H}) µT in H: {halves.distance:.1f} times as "
        "much as the sigmas allow"
    )


def _meaning(case: Case, level: Level, difference: str) -> tuple[Level, str]:
    """Return what it means: other sensors saw the same map from the same poses."""
    others = [each.halves for each in case.others if not each.halves.reason]
    same = [halves_agree(each, case.options) for each in others]
    disturbed = any(case.sensor.sensor in each.sensors for each in case.result.disagreements)
    if same and sum(same) > len(same) / 2 and level is Level.FAIL:
        return level, (
            f"It does not hold still: {difference}, while other sensors repeat. It moved on its "
            "mount, or something magnetic near it did; fasten it and drive again."
        )
    if disturbed:
        return Level.WARN, (
            f"It repeats less well than its sigmas say: {difference}. Readings where the place has "
            "changed since it was mapped were rejected; near them others may be a little off."
        )
    return level, f"It does not repeat: {difference}."

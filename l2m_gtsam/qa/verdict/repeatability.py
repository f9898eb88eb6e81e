"""Rules on repeatability: halves of a drive, or several drives, calibrated by themselves."""

from collections.abc import Sequence
from math import isfinite, radians
from pathlib import Path

from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.verdict.sensor import Case
from l2m_gtsam.records.calibration import SensorStatus
from l2m_gtsam.records.metrics import SensorMetrics
from l2m_gtsam.records.repeatability import DriveRepeat, GroupDistance, Halves, Repeatability
from l2m_gtsam.records.verdict import Level, Reason
from l2m_gtsam.solve.chi_square import quantile

# After any other ending the halves do not test the mounting.
JUDGED = (SensorStatus.SOLVED, SensorStatus.CONTRADICTED, SensorStatus.NOT_CONVERGED)


def repeat(case: Case) -> list[Reason]:
    """Return by how much parts differ, where they do, and which cannot be looked at."""
    if case.metrics is None or case.sensor.status not in JUDGED or not case.options.halves:
        return []
    notes = _not_looked_at(case.metrics)
    halves = differing(case.metrics, case.options)
    if halves is None:
        return notes
    level = case.options.halves_apart.level(furthest(halves, case.options))
    difference = _difference(halves, _where(case.metrics, case.options), case.options)
    return [Reason(*_meaning(case, level, difference)), *notes]


def halves_agree(halves: Halves, options: QaOptions) -> bool:
    """Return whether two halves agree within their sigmas, or within what is negligible."""
    return not furthest(halves, options) > options.halves_apart.warn


def furthest(halves: Halves, options: QaOptions) -> float:
    """Return how far halves are apart in t, C or H, over what chance allows; NaN without any.

    What is negligible counts as nothing; `qa.halves` leaves the comparison out.
    """
    if not halves.distances or not options.halves:
        return float("nan")
    return max(_judged(each, halves, options) for each in halves.distances)


def furthest_shown(halves: Halves, options: QaOptions) -> tuple[float, str]:
    """Return how far halves are apart, over what chance allows, and why it passes nevertheless.

    That is said, as a phrase, where it would warn but what it is of is negligible.
    """
    judged, limit = furthest(halves, options), options.halves_apart.warn
    if not judged <= limit:
        return judged, ""
    ratios = {each.name: _apart(each, halves, options) for each in halves.distances}
    small = [name for name, ratio in ratios.items() if ratio > limit]
    passes = f"{', '.join(_under(name, options) for name in small)}, passes" if small else ""
    return max(ratios.values()), passes


def _under(name: str, options: QaOptions) -> str:
    """Return what a difference is less than, as a phrase."""
    t, H = f"{1e3 * options.halves_m:g} mm", f"{options.halves_ut:g} µT"
    alone = {"t": t, "C": f"{options.halves_deg:g}°", "H": H}
    return f"{name} under {alone.get(name, f'{t}, {options.halves_deg:g}° and {H}')}"


def _judged(found: GroupDistance, halves: Halves, options: QaOptions) -> float:
    negligible = _negligible(found.name, halves, options)
    return 0.0 if negligible else _apart(found, halves, options)


def _apart(found: GroupDistance, halves: Halves, options: QaOptions) -> float:
    return float((found.chi_square / limit_of(found, halves, options)) ** 0.5)


def limit_of(found: GroupDistance, halves: Halves, options: QaOptions) -> float:
    """Return the chi-square that chance exceeds so seldom: all of t, C and H have one chance."""
    share = 1 - options.halves_chance / len(halves.distances)
    return float(quantile(share, max(found.freedom, 1)))


def _negligible(name: str, halves: Halves, options: QaOptions) -> bool:
    """Return whether nobody minds what t, C, H, or all of them, differ by."""
    small = {
        "t": _length(halves.difference[:3]) < options.halves_m,
        "C": not halves.turned_deg >= options.halves_deg
        and max(map(abs, _known(halves.difference[3:12])), default=0) < radians(options.halves_deg),
        "H": _length(halves.difference[12:]) < options.halves_ut,
    }
    return small.get(name, all(small.values()))


def _length(values: Sequence[float]) -> float:
    return float(sum(each**2 for each in _known(values)) ** 0.5)


def _known(values: Sequence[float]) -> list[float]:
    """Return what both parts determine of a difference."""
    return [each for each in values if isfinite(each)]


def differing(metrics: SensorMetrics, options: QaOptions) -> Halves | None:
    """Return the comparison of parts that do not agree: of several drives the furthest one."""
    if metrics.drives is None:
        return None if halves_agree(metrics.halves, options) else metrics.halves
    furthest = _furthest(metrics.drives, options)
    return None if furthest is None else furthest.others


def _furthest(drives: Repeatability, options: QaOptions) -> DriveRepeat | None:
    """Return the drive that is furthest from the others; of two the later one."""
    off = [each for each in drives.compared if not halves_agree(each.others, options)]
    # Both of two drives are equally far from each other, to rounding.
    return max(
        reversed(off), key=lambda each: round(furthest(each.others, options), 6), default=None
    )


def _compared(metrics: SensorMetrics) -> bool:
    if metrics.drives is None:
        return not metrics.halves.reason
    return len(metrics.drives.compared) > 1


def _where(metrics: SensorMetrics, options: QaOptions) -> str:
    """Return where it differs, as the beginning of a clause."""
    furthest = None if metrics.drives is None else _furthest(metrics.drives, options)
    if metrics.drives is None or furthest is None:
        return "calibrated on both halves of the drive it differs by"
    name = Path(furthest.bag).name
    others = [each for each in metrics.drives.compared if each is not furthest]
    if len(others) == 1:
        return (
            "calibrated on each drive by itself it differs between "
            f"{Path(others[0].bag).name} and {name} by"
        )
    return f"calibrated on each drive by itself it differs in {name} from the other drives by"


def _difference(halves: Halves, where: str, options: QaOptions) -> str:
    t = ", ".join(_rounded(1e3 * each, 0) for each in halves.difference[:3])
    H = ", ".join(_rounded(each, 1) for each in halves.difference[12:])
    return (
        f"{where} ({t}) mm in place, "
        f"{_rounded(halves.turned_deg, 1)}° in rotation and ({H}) µT in H: "
        f"{_beyond(halves, options)}"
    )


def _rounded(value: float, digits: int) -> str:
    """Return a difference with so many digits; a dash for what a part leaves open."""
    return f"{value:.{digits}f}" if isfinite(value) else "–"


def _beyond(halves: Halves, options: QaOptions) -> str:
    """Return in which of t, C and H sigmas do not explain a difference, and by how much."""
    worst = sorted(
        (each for each in halves.distances if _judged(each, halves, options) > 1),
        key=lambda each: -_judged(each, halves, options),
    )
    listed = ", ".join(
        f"{each.name} (chi-square {each.chi_square:.0f} of {each.freedom}, limit "
        f"{limit_of(each, halves, options):.0f})"
        for each in worst
    )
    return f"more than sigmas explain in {listed}"


def _meaning(case: Case, level: Level, difference: str) -> tuple[Level, str]:
    """Return what it means: other sensors saw the same map from the same poses."""
    # A reading or two say nothing about the others: as many as are worth a warning by themselves.
    disturbed = case.sensor.rejected > case.options.rejected.warn * case.sensor.inside
    if _others_repeat(case) and level is Level.FAIL:
        return level, (
            f"It does not hold still: {difference}, while other sensors repeat. It moved on its "
            f"mount, or something magnetic near it did; {_remedy(case)}."
        )
    if disturbed and not case.result.bags:
        return Level.WARN, (
            f"It repeats less well than its sigmas predict: {difference}. Readings where the place "
            "has changed since it was mapped were rejected; near them others may be a little off."
        )
    return level, f"It does not repeat: {difference}."


def _others_repeat(case: Case) -> bool:
    """Return whether there are other sensors to compare with, most of which repeat."""
    same = [differing(each, case.options) is None for each in case.others if _compared(each)]
    return sum(same) > len(same) / 2


def moved(case: Case) -> bool:
    """Return whether a sensor alone, of several, is elsewhere in one of several drives."""
    if case.metrics is None or case.metrics.drives is None or not _others_repeat(case):
        return False
    return any(each.level is Level.FAIL for each in repeat(case))


def _remedy(case: Case) -> str:
    if case.result.bags:
        return "fasten it, and calibrate drives from before and after apart"
    return "fasten it and drive again"


def _not_looked_at(metrics: SensorMetrics) -> list[Reason]:
    """Return which of several drives determine nothing by themselves, and why.

    That the only drive which does has nothing to be compared with follows from the others.
    """
    drives = () if metrics.drives is None else metrics.drives.drives
    known = [each for each in drives if any(map(isfinite, each.estimate))]
    return [
        Reason(
            Level.PASS,
            f"{Path(each.bag).name} is not compared with the other drives: {each.reason}.",
        )
        for each in drives
        if each.reason and known != [each]
    ]

"""What concerns all sensors: the map, the place, the drive."""

from pathlib import Path

import numpy as np

from l2m_gtsam.qa.reasons.fit import misfit
from l2m_gtsam.qa.reasons.reason import Case, Level, Reason
from l2m_gtsam.records.calibration import CalibrationResult, Disagreement, Return, SensorStatus

HEADS = {
    Return.NEVER: "The environment has changed, or something passed by",
    Return.AS_MAPPED: "Something passed by",
    Return.DIFFERS: "The environment has changed since it was mapped",
}
TAILS = {
    Return.NEVER: "It was not passed again, which would tell",
    Return.AS_MAPPED: "Passed again the place was as mapped",
    Return.DIFFERS: "Passed again it differed, too: map it anew",
}
OPEN = (SensorStatus.UNDETERMINED, SensorStatus.NOT_CONVERGED, SensorStatus.NO_READINGS)
MANY = 4  # stretches that are told one by one


def whole(cases: tuple[Case, ...], result: CalibrationResult) -> list[Reason]:
    """Return what speaks against map, place and drive."""
    reasons = [Reason(Level.WARN, f"Of the map: {doubt}.") for doubt in result.doubts]
    shared = [each for each in result.disagreements if _shared(each, result)]
    reasons += [Reason(Level.WARN, _changed(each, result)) for each in shared[:MANY]]
    if len(shared) > MANY:
        more = f"The place differs from the map along {len(shared) - MANY} more stretches."
        reasons.append(Reason(Level.WARN, more))
    # What a map of another place says of this one means nothing.
    return _misfit(cases) or [*_drive(cases), *reasons]


def _drive(cases: tuple[Case, ...]) -> list[Reason]:
    """Return what the drive lacks, if it left something open."""
    if not any(map(_left_open, cases)):
        return []
    drive, options = cases[0].all.drive, cases[0].options
    reasons = []
    if drive.length < options.short_drive_m:
        text = (
            f"The drive is short, {drive.length:.1f} m in {drive.seconds:.0f} s: drive on, through "
            "more places and headings."
        )
        reasons.append(Reason(Level.WARN, text))
    if drive.heading < options.few_headings:
        text = (
            f"The vehicle took {drive.heading:.0%} of all headings only, much of a straight line: "
            "drive curves and loops, both ways round."
        )
        reasons.append(Reason(Level.WARN, text))
    return reasons


def _left_open(case: Case) -> bool:
    """Whether the drive does not say of a sensor what it should."""
    too_large = case.sensor.t_sigma.max() > case.options.position_sigma_m.warn
    return case.sensor.status in OPEN or bool(too_large)


def own_stretches(case: Case) -> list[Reason]:
    """Return stretches over which this sensor alone, of several, disagreed with the map."""
    own = [
        each
        for each in case.result.disagreements
        if each.sensors == (case.sensor.sensor,) and not _shared(each, case.result)
    ]
    if not own:
        return []
    readings = sum(each.readings for each in own)
    text = (
        f"Along {len(own)} stretch{'es' if len(own) > 1 else ''} of the drive ({readings} "
        "readings) it alone disagrees with the map, other sensors do not: something near it was "
        "switched or moved."
    )
    return [Reason(Level.WARN, text)]


def _shared(stretch: Disagreement, result: CalibrationResult) -> bool:
    """Whether it concerns the place: more than one sensor, or the only one."""
    solved = [each for each in result.sensors if each.residuals is not None]
    return len(stretch.sensors) > 1 or len(solved) == 1


def _changed(stretch: Disagreement, result: CalibrationResult) -> str:
    (x0, y0), (x1, y1) = stretch.p_from[:2], stretch.p_to[:2]
    count = len(stretch.sensors)
    start = min(each.start_ns for each in result.disagreements if each.bag == stretch.bag)
    after = 1e-9 * (stretch.start_ns - start)
    when = f", {after:.0f} s after the first" if after >= 1 else ""
    drive = f" in {Path(stretch.bag).name}" if stretch.bag else ""
    return (
        f"{HEADS[stretch.passed_again]}: from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) m on "
        f"the map{drive}{when}, {stretch.length:.1f} m long, "
        f"{count} sensor{'s' if count > 1 else ''} differ{'' if count > 1 else 's'} by "
        f"{stretch.size:.2g} µT. "
        f"{TAILS[stretch.passed_again]}. These {stretch.readings} readings do not count."
    )


def _misfit(cases: tuple[Case, ...]) -> list[Reason]:
    """Return that the map is the wrong one, if no sensor fits it."""
    told = [case for case in cases if case.metrics and np.isfinite(case.sensor.t_sigma).all()]
    if not told or not all(map(misfit, told)):
        return []
    text = (
        "The map does not fit this drive: a field that is the same everywhere explains the "
        "readings as well. Is it the map of this place, and are the poses in its frame?"
    )
    return [Reason(Level.FAIL, text)]

"""The verdict on a calibration: PASS, WARN or FAIL, with reasons in plain sentences."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.qa.verdict.mounting import mounting
from l2m_gtsam.qa.verdict.places import source_reasons, stretch_head, stretch_tail
from l2m_gtsam.qa.verdict.reasons import failure, note, warning
from l2m_gtsam.qa.verdict.repeatability import furthest_shown, moved, repeat
from l2m_gtsam.qa.verdict.sensor import (
    WRONG_MAP,
    Case,
    clock,
    ending,
    fit,
    misfit,
    precision,
    saturation,
    unconverged,
)
from l2m_gtsam.qa.verdict.uncertainty import disturbance_reasons, jump_reasons, stated_wrongly
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    Disagreement,
    SensorCalibration,
    SensorStatus,
    Uncertainty,
)
from l2m_gtsam.records.error_budget import DisturbanceKind, DurationSource
from l2m_gtsam.records.metrics import Measures, SensorMetrics
from l2m_gtsam.records.verdict import Judgement, Level, Reason, SensorVerdict, Verdict
from l2m_gtsam.text import significant

OPEN = (SensorStatus.UNDETERMINED, SensorStatus.NOT_CONVERGED, SensorStatus.NO_READINGS)
LOWER_BOUNDS = (
    "Its sigmas are lower bounds: they count errors of the map as each reading's own, though "
    "readings near each other share them. Use a harmonic map, with `uncertainty: full`."
)
COMMON = (
    "What all sensors of the survey are off by together need not show: it goes one to one into "
    "every t and rotation."
)
Rule = Callable[[Case], list[Reason]]
MANY = 4  # stretches that are listed one by one
SURE = 5.0  # times what a uniform field leaves: a jump so large is no error of the map


def judge(result: CalibrationResult, metrics: Measures, options: QaOptions) -> Verdict:
    """Return the verdict on a calibration.

    Parameters
    ----------
    metrics
        Its figures.
    options
        Thresholds.
    """
    cases = tuple(
        Case(sensor, metrics.get(sensor.sensor), result, metrics, options)
        for sensor in result.sensors
    )
    return Verdict.of(_shared_reasons(cases, result), [_on_sensor(case) for case in cases])


def judgement_of(result: CalibrationResult, metrics: Measures, options: QaOptions) -> Judgement:
    """Return the verdict with its thresholds, and what was judged before by other thresholds.

    Parameters
    ----------
    result, metrics, options
        As of `judge`.
    """
    absent = {"map_days"} if options.map_days is None else set()
    used = options.model_dump(mode="json", exclude={"validation", "slam", *absent})
    return Judgement.of(judge(result, metrics, options), used, result.judgement)


def _on_sensor(case: Case) -> SensorVerdict:
    reasons = [reason for rule in _rules(case) for reason in rule(case)]
    ended = unconverged(case)
    if ended and all(each.level is not Level.FAIL for each in reasons):
        causes = [reason for rule in CAUSES for reason in rule(case) if reason in reasons]
        if cause := next((each for each in causes if each.level is Level.WARN), None):
            reasons.remove(cause)
            ended = [Reason(Level.FAIL, f"{cause.text} {each.text}") for each in ended]
    return SensorVerdict.of(case.sensor.sensor, [*reasons, *ended])


def _rules(case: Case) -> tuple[Rule, ...]:
    if not misfit(case):
        return RULES
    # At two places at once it fits none, nor anything that is found of it.
    return RULES_OF_A_MOVED if moved(case) else RULES_OF_A_MISFIT


def _shared_reasons(cases: tuple[Case, ...], result: CalibrationResult) -> list[Reason]:
    """Return what speaks against map, place and drive."""
    reasons = [Reason(Level.WARN, f"Of the map: {doubt}.") for doubt in result.doubts]
    reasons += source_reasons(result.sources)
    reasons += _of_its_survey(result)
    reasons += _old_map(result, cases[0].options) if cases else []
    shared = [each for each in result.disagreements if _is_shared(each, result)]
    reasons += [Reason(Level.WARN, _changed(each, result)) for each in shared[:MANY]]
    if len(shared) > MANY:
        more = f"The place differs from the map along {len(shared) - MANY} more stretches."
        reasons += warning(more)
    # A map of another place is no evidence on this one.
    reasons += disturbance_reasons(result, None)
    reasons += _beside_moved(cases) or stated_wrongly(result.stated, None, result.pose_duration)
    elsewhere = _wrong_map(cases) or _bent_too_far(cases, result)
    return elsewhere or [*_on_drive(cases), *reasons, *_exact(result)]


def _beside_moved(cases: tuple[Case, ...]) -> list[Reason]:
    """Return what a sensor that stood in two places does to all others: it is no error of poses."""
    names = [case.sensor.sensor for case in cases if misfit(case) and moved(case)]
    if not names:
        return []
    return warning(
        f"Sigmas of all sensors are larger by what {', '.join(names)} leaves: calibrate the drives "
        "apart, or leave it out (`bag.fields`)."
    )


def _of_its_survey(result: CalibrationResult) -> list[Reason]:
    """Return that the map was made from drives on which sensors are calibrated."""
    sources = () if result.map_origin is None else result.map_origin.sources
    surveyed = {each.sha256 for each in sources}
    if not (own := [each.path for each in result.drives if each.sha256 in surveyed]):
        return []
    return warning(
        f"The map was made from {', '.join(own)}: noise is in both, and sensors that surveyed come "
        "out as they were assumed, right or wrong; calibrate on another drive."
    )


def _old_map(result: CalibrationResult, options: QaOptions) -> list[Reason]:
    """Return that the map is older than it may be."""
    limit, age = options.map_days, result.map_age_days
    if limit is None or age is None or age <= limit:
        return []
    return warning(
        f"The map was {age:.3g} days old at the drive, more than the {limit:g} of `qa.map_days`: "
        "steel may have changed since; survey the place again."
    )


def _exact(result: CalibrationResult) -> list[Reason]:
    """Return what the sigmas know no errors of, and what they have from the readings alone."""
    reasons = []
    if (lasting := result.pose_duration) and lasting.source is DurationSource.FOUND:
        text = f"Errors of poses last {significant(lasting.seconds, 2)} s, by the readings."
        reasons += note(text)
    found = [each.drive_noise for each in result.sensors if each.drive_noise]
    if 2 * len(found) > len(result.sensors):  # of one alone it may have been moved
        sizes = zip(result.bags, np.median(found, axis=0).tolist(), strict=True)
        each = ", ".join(f"{significant(size, 2)} µT in {bag.path}" for bag, size in sizes)
        text = f"Noise differs between drives: {each}. Each reading counts with that of its own."
        reasons += note(text)
    if size := result.unseen_warp_m:
        reasons += note(
            f"The drive's frame may be bent against the map's by {1e3 * size:.1f} mm: the readings "
            "would not show it. Sigmas include it."
        )
    if result.exact:
        common = f" {COMMON}" if "the survey's sensors" in result.exact else ""
        reasons += note(f"Taken as exact: {', '.join(result.exact)}.{common}")
    return reasons


def _wrong_map(cases: tuple[Case, ...]) -> list[Reason]:
    """Return that the map is the wrong one, if no sensor fits it."""
    known = [
        case
        for case in cases
        if case.metrics and (np.isfinite(case.sensor.t_sigma).all() or misfit(case))
    ]
    if not known or not all(map(misfit, known)):
        return []
    return failure(WRONG_MAP)


def _bent_too_far(cases: tuple[Case, ...], result: CalibrationResult) -> list[Reason]:
    """Return that a drive fits the map only if its frame is bent as none is."""
    warps = [each for each in result.disturbances if each.kind is DisturbanceKind.WARP]
    size = max((each.sizes["shift_m"] for each in warps), default=0.0)
    if not cases or size <= cases[0].options.warp_m:
        return []
    return failure(
        f"The drive fits the map only if its frame is bent by {size:.2g} m, more than a frame of "
        "one place is (`qa.warp_m`). Is it the map of this place, and are the poses in its frame?"
    )


def _on_drive(cases: tuple[Case, ...]) -> list[Reason]:
    """Return what the drive lacks, if it left something open."""
    if not any(map(_left_open, cases)):
        return []
    drive, options = cases[0].all.drive, cases[0].options
    reasons = []
    if drive.length < options.short_drive_m:
        reasons += warning(
            f"The drive is short, {drive.length:.1f} m in {drive.seconds:.0f} s: drive on, through "
            "more places and headings."
        )
    if drive.heading < options.few_headings:
        reasons += warning(
            f"The vehicle took {drive.heading:.0%} of all headings only, much of a straight line: "
            "drive curves and loops in both directions."
        )
    return reasons


def _left_open(case: Case) -> bool:
    """Whether the drive does not determine of a sensor what it should."""
    too_large = case.sensor.t_sigma.max() > case.options.position_sigma_m.warn
    return case.sensor.status in OPEN or bool(too_large)


def _own_disturbances(case: Case) -> list[Reason]:
    """Return what disturbed this sensor alone."""
    sensor = case.sensor.sensor
    return [*jump_reasons(case.result, sensor), *disturbance_reasons(case.result, sensor)]


def _large_jumps(case: Case) -> list[Reason]:
    """Return the jumps of its H that no map can make up.

    A uniform field leaves much less of the readings, once the jumps are taken off.
    """
    if case.metrics is None:
        return []
    least = case.metrics.fit.without_map
    jumps = [each for each in case.result.jumps if np.linalg.norm(each.change) > SURE * least]
    return jump_reasons(replace(case.result, jumps=tuple(jumps)), case.sensor.sensor)


def _stated(case: Case) -> list[Reason]:
    """Return what was stated of this sensor that its readings speak against."""
    return stated_wrongly(case.result.stated, case.sensor.sensor, None)


def _own_stretches(case: Case) -> list[Reason]:
    """Return stretches over which this sensor alone, of several, disagreed with the map."""
    own = [
        each
        for each in case.result.disagreements
        if each.sensors == (case.sensor.sensor,) and not _is_shared(each, case.result)
    ]
    if not own:
        return []
    readings = sum(each.readings for each in own)
    return warning(
        f"Along {len(own)} stretch{'es' if len(own) > 1 else ''} of the drive ({readings} "
        "readings) it alone disagrees with the map, other sensors do not: something near it was "
        "switched or moved."
    )


def _is_shared(stretch: Disagreement, result: CalibrationResult) -> bool:
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
        f"{stretch_head(stretch)}: from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) m on "
        f"the map{drive}{when}, {stretch.length:.1f} m long, "
        f"{count} sensor{'s' if count > 1 else ''} differ{'' if count > 1 else 's'} by "
        f"{significant(stretch.size, 2)} µT. "
        f"{stretch_tail(stretch)}. These {stretch.readings} readings do not count."
    )


def _lower_bounds(case: Case) -> list[Reason]:
    """Return that sigmas do not know how errors of the map are shared, if it has any."""
    full = case.result.uncertainty is not Uncertainty.INDEPENDENT
    if full or case.metrics is None or not case.metrics.fit.map_noise:
        return []
    return warning(LOWER_BOUNDS)


# In the order in which a person would ask; the worst come first in the end.
RULES = (
    saturation,
    repeat,
    ending,
    mounting,
    fit,
    _own_stretches,
    clock,
    precision,
    _own_disturbances,
    _stated,
    _lower_bounds,
)
RULES_OF_A_MISFIT = (saturation, fit, ending, _large_jumps)
RULES_OF_A_MOVED = (saturation, repeat, ending)
# What may keep a solve from converging: named before that.
CAUSES = (saturation, _own_stretches, repeat, fit)


@dataclass(frozen=True)
class Measured:
    """A figure beside its limit.

    Attributes
    ----------
    name, unit
        What it is of, and in which unit all three numbers are.
    value
        As it was measured; infinite where it is not determined.
    warn, fail
        Where the verdict changes.
    passes
        Why it passes although it is above a limit, as a phrase; else empty.
    undetermined
        What it leads to where it is not determined, as in ``ending``.
    """

    name: str
    unit: str
    value: float
    warn: float
    fail: float
    passes: str
    undetermined: Level

    @property
    def level(self) -> Level:
        """What it leads to by itself."""
        if self.passes:
            return Level.PASS
        by_value = Limit(warn=self.warn, fail=self.fail).level(self.value)
        return self.undetermined if np.isinf(self.value) else by_value


def measured(
    sensor: SensorCalibration, found: SensorMetrics, options: QaOptions
) -> tuple[Measured, ...]:
    """Return the figures of a sensor that was solved, sigmas first.

    Parameters
    ----------
    sensor, found
        Its calibration and its figures.
    options
        Thresholds.
    """
    chi2 = np.nan if sensor.residuals is None else sensor.residuals.chi2_per_dof
    apart, passes = furthest_shown(found.halves, options)
    outside = _share(sensor.outside_map, sensor.inside + sensor.outside_map)
    every = (
        _in("sigma of t", "mm", _largest(sensor.t_sigma), options.position_sigma_m, 1e3),
        _in("sigma of rotation", "°", _largest(sensor.turn_sigma_deg), options.rotation_sigma_deg),
        replace(
            _in("sigma of H", "µT", _largest(sensor.H_sigma), options.hard_iron_sigma_ut),
            undetermined=Level.WARN,
        ),
        _in("unexplained by the map", "", found.fit.unexplained, options.unexplained),
        _in("chi-square", "", chi2, options.chi_square),
        _in("halves apart, over what chance allows", "", apart, options.halves_apart, 1.0, passes),
        _in("rejected", "%", _share(sensor.rejected, sensor.inside), options.rejected, 100),
        _in("outside the map", "%", outside, options.outside_map, 100),
        _in("beyond the range", "%", _beyond_range(sensor), options.saturated, 100),
    )
    return tuple(each for each in every if not np.isnan(each.value))


def _in(
    name: str, unit: str, value: float, limit: Limit, factor: float = 1.0, passes: str = ""
) -> Measured:
    limits = (factor * limit.warn, factor * limit.fail)
    return Measured(name, unit, factor * value, *limits, passes, undetermined=Level.FAIL)


def _largest(sigmas: FloatArray) -> float:
    return float(sigmas.max())


def _beyond_range(sensor: SensorCalibration) -> float:
    """Return the share of readings beyond the range along the worst axis; NaN if there are none."""
    return max((each.share for each in sensor.sync.limits), default=float("nan"))


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")

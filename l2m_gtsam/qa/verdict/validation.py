"""The verdict on a calibration that was tested on another drive, or beside an older one."""

from collections.abc import Callable

import numpy as np

from l2m_gtsam.qa.metrics.changes import change_of
from l2m_gtsam.qa.options import QaOptions, thresholds
from l2m_gtsam.qa.verdict.changed_parts import (
    NAMES,
    amount,
    by_how_much,
    change_reason,
    limits_of,
)
from l2m_gtsam.qa.verdict.displacement import displaced, moved_with_all
from l2m_gtsam.qa.verdict.places import source_reasons
from l2m_gtsam.qa.verdict.reasons import failure, note, warning
from l2m_gtsam.qa.verdict.sensor import WRONG_MAP, beyond_range, outside_map
from l2m_gtsam.qa.verdict.uncertainty import jump_sentence
from l2m_gtsam.records.error_budget import MOST_JUMPS, OffsetDrift
from l2m_gtsam.records.validation import (
    CalibrationComparison,
    CalibrationPart,
    ComparedSensor,
    DriveValidation,
    NotValidated,
    ValidatedSensor,
)
from l2m_gtsam.records.verdict import Level, Reason, SensorVerdict, Threshold, Verdict
from l2m_gtsam.text import significant

SHARED_LIMITS = ("unexplained", "rejected", "outside_map", "saturated")
EXPECTED_TIMES = 2.0  # a refit that leaves no more than this of what is expected fits the map


def judge_validation(
    drive: DriveValidation | None, comparison: CalibrationComparison | None, options: QaOptions
) -> Verdict:
    """Return the verdict with its reasons.

    Parameters
    ----------
    drive
        The test on a drive, if there was one.
    comparison
        What has changed since an older calibration, if there was one.
    options
        Thresholds.
    """
    shared: list[Reason] = []
    found: dict[str, list[Reason]] = {}
    if drive is not None:
        shared += _on_drive(drive, options)
        shared += displaced(drive, options)
        for sensor in drive.sensors:
            found.setdefault(sensor.sensor, []).extend(
                [
                    *_exchanged(sensor),
                    *moved_with_all(drive, options),
                    *_jumped(drive, sensor, options),
                    *_drifted(drive, sensor, options),
                    *_on_sensor(sensor, options),
                ]
            )
        _add_missing(found, drive.missing)
    if comparison is not None:
        shared += note(comparison.assumption)
        if comparison.same_bag:
            shared += warning("One drive took part in both calibrations.")
        for name in comparison.failed:
            text = f"The {name} calibration itself was judged FAIL: its calibration.yaml says why."
            shared += warning(text)
        for each in comparison.sensors:
            found.setdefault(each.sensor, []).extend(_on_comparison(each, options))
        _add_missing(found, comparison.missing)
    return Verdict.of(shared, [SensorVerdict.of(*each) for each in found.items()])


def validation_thresholds(options: QaOptions) -> tuple[Threshold, ...]:
    """Return where the verdict changes."""
    return thresholds(options, SHARED_LIMITS) + thresholds(options.validation, prefix="validation.")


def _add_missing(found: dict[str, list[Reason]], missing: tuple[NotValidated, ...]) -> None:
    for each in missing:
        level = Level.FAIL if each.faulty else Level.WARN
        found.setdefault(each.sensor, []).append(Reason(level, each.reason))


def _on_drive(drive: DriveValidation, options: QaOptions) -> list[Reason]:
    """Return what concerns all sensors."""
    if drive.sensors and all(_misfit(each, options) for each in drive.sensors):
        return failure(f"{WRONG_MAP} The calibration was not tested.")
    return [
        *(Reason(Level.WARN, each) for each in drive.doubts),
        *source_reasons(drive.sources),
        *(Reason(Level.PASS, each) for each in drive.notes),
    ]


def _exchanged(sensor: ValidatedSensor) -> list[Reason]:
    """Return that a sensor reads what another should."""
    if not sensor.reads_as:
        return []
    return failure(
        f"Its readings fit the calibration of {sensor.reads_as}, not its own: sensors are "
        "exchanged. Exchange their topics, their cables or their names in `bag.fields`. It was "
        f"tested as {sensor.reads_as}."
    )


def _jumped(drive: DriveValidation, sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    """Return the jumps of its H during the drive; many of them are one that wanders."""
    own, limit = [e for e in drive.jumps if e.sensor == sensor.sensor], options.validation.offset_ut
    if len(own) < MOST_JUMPS:
        sizes = [float(np.linalg.norm(each.change)) for each in own]
        return [Reason(limit.level(s), jump_sentence(e)) for s, e in zip(sizes, own, strict=True)]
    change = np.sum([each.change for each in own], axis=0)
    sigma = np.linalg.norm([each.sigma for each in own], axis=0)
    whole = change_of(CalibrationPart.OFFSET, change, sigma, 0.0)
    text = (
        f"From {own[0].seconds:.0f} to {own[-1].seconds:.0f} s after the first reading that "
        f"counts, its offset H wanders, by {by_how_much(whole)} in all: the sensor warms up, or "
        "something moves near it. Other changes of it may be of that."
    )
    return [Reason(limit.level(whole.size), text)]


def _drifted(drive: DriveValidation, sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    """Return that its H drifted over the drive."""
    own = [each for each in drive.drifts if each.sensor == sensor.sensor]
    return [_of_drift(each, options) for each in own]


def _of_drift(drift: OffsetDrift, options: QaOptions) -> Reason:
    """Return that H drifted, by how much and why."""
    change, sigma = np.array(drift.change), np.array(drift.sigma)
    whole = change_of(CalibrationPart.OFFSET, change, sigma, 0.0)
    text = (
        f"Over the drive its offset H drifts by {by_how_much(whole)}, half of it in the first "
        f"{drift.half_s:.0f} s: the sensor warms up, or something on the vehicle gains or loses "
        "magnetisation. Its other changes are beside that."
    )
    return Reason(options.validation.offset_ut.level(whole.size), text)


def _misfit(sensor: ValidatedSensor, options: QaOptions) -> bool:
    """Whether no C and H make the readings of a sensor follow the map."""
    above = options.unexplained.level(sensor.unexplained) is Level.FAIL
    return above and sensor.refitted > EXPECTED_TIMES * sensor.expected


def _on_sensor(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    beyond = beyond_range(sensor.limits, options)
    if _misfit(sensor, options):
        text = (
            f"Whatever C and H are, the map leaves {significant(sensor.refitted, 2)} µT of its "
            f"readings, a field that is the same everywhere {significant(sensor.uniform, 2)} µT: "
            "the map does not fit what it reads here."
        )
        return [*beyond, Reason(Level.FAIL, text)]
    rules: tuple[Callable[[ValidatedSensor, QaOptions], list[Reason]], ...] = (
        _changed,
        _consistent,
        _counted,
        _blind,
        _ending,
    )
    return [*beyond, *(reason for rule in rules for reason in rule(sensor, options))]


def _changed(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    share = sensor.rejected / (sensor.readings + sensor.rejected)
    doubt = ""
    if options.rejected.level(share) is not Level.PASS:
        doubt = " (Readings were rejected, see below; other changes near them may bias this.)"
    return [
        change_reason(
            each, options, "On this drive {name} differ{s} from the calibration by {amount}", doubt
        )
        for each in sensor.changes
    ]


def _consistent(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    """Return that residuals are larger than they should be, where no change explains it."""
    if sensor.changes:
        return []
    times = sensor.nis.ratio**0.5
    text = (
        f"Its residuals are {times:.1f} times as large as noise, map and calibration lead to "
        "expect, and no change of the calibration explains it: it is noisier than it was, or the "
        "map is less exact here than it states."
    )
    return options.validation.nis.reasons(sensor.nis.ratio, text)


def _counted(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    within = sensor.readings + sensor.rejected
    share, lost = sensor.rejected / within, sensor.outside / (within + sensor.outside)
    return [
        *options.rejected.reasons(
            share,
            f"{share:.0%} of its readings fit no calibration that explains the others and do not "
            "count: the place has changed there since it was mapped, or something passed by.",
        ),
        *outside_map(lost, options),
    ]


def _blind(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    """Return which changes that would fail the drive need not have shown."""
    hidden = _hidden(sensor, options, "it shows")
    if not hidden:
        return []
    return warning(f"This drive cannot rule out a change that would FAIL: {hidden}.")


def _hidden(sensor: ValidatedSensor | ComparedSensor, options: QaOptions, shows: str) -> str:
    """Return parts of a sensor whose changes would fail and need not show, as a phrase."""
    limits, named = limits_of(options.validation), {each.part for each in sensor.changes}
    return ", ".join(
        f"{NAMES[each.part]} ({shows} changes from {amount(each.part, each.size)} on)"
        if np.isfinite(each.size)
        else f"{NAMES[each.part]} (no change of it shows)"
        for each in sensor.detectable
        if each.part not in (*named, CalibrationPart.CLOCK) and each.size > limits[each.part].fail
    )


def _ending(sensor: ValidatedSensor, _: QaOptions) -> list[Reason]:
    if not sensor.ending:
        return []
    return warning(f"Of its calibration: {sensor.ending.rstrip('.')}.")


def _on_comparison(sensor: ComparedSensor, options: QaOptions) -> list[Reason]:
    """Return what has changed since the older calibration, and what might have unseen."""
    whole = sensor.test("all")
    if not whole.freedom:
        return warning("The two calibrations determine nothing of it in common.")
    reasons = _since(sensor, options)
    if hidden := _hidden(sensor, options, "they show"):
        text = f"The two calibrations cannot rule out a change that would FAIL: {hidden}."
        reasons += warning(text)
    return reasons


def _since(sensor: ComparedSensor, options: QaOptions) -> list[Reason]:
    """Return what has changed since the older calibration."""
    whole = sensor.test("all")
    if sensor.changes:
        return [
            change_reason(
                each, options, "since the old calibration {name} {has} changed by {amount}"
            )
            for each in sensor.changes
        ]
    if whole.chance < options.validation.chance / (len(NAMES)):
        times = (whole.chi_square / whole.freedom) ** 0.5
        return warning(
            f"The two calibrations differ {times:.1f} times as much as their uncertainties allow, "
            "in no single part of it beyond chance: several parts have changed a little together."
        )
    return note("No change since the old calibration beyond both uncertainties.")

"""The verdict on a calibration that was tested on another drive, or beside an older one."""

from collections.abc import Callable

import numpy as np

from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.qa.reasons.reason import Level, Reason, against, level_of, worst
from l2m_gtsam.qa.validation.sentences import MEANINGS, NAMES, amount, by_how_much, limits_of
from l2m_gtsam.records.validation import (
    CalibrationComparison,
    Change,
    ComparedSensor,
    DriveValidation,
    NotValidated,
    Part,
    Remark,
    SensorRemarks,
    Threshold,
    ValidatedSensor,
    ValidationVerdict,
)

SHARED_LIMITS = ("unexplained", "rejected", "outside_map")
BLIND_TIMES = 2.0  # a change that would fail, so many times over, and would not show
EXPECTED_TIMES = 2.0  # a refit that leaves no more than this of what is expected fits the map


def judge_validation(
    drive: DriveValidation | None, comparison: CalibrationComparison | None, options: QaOptions
) -> ValidationVerdict:
    """Return the verdict with its reasons.

    Parameters
    ----------
    drive
        What a drive says of the calibration, if there was one.
    comparison
        What has changed since an older calibration, if there was one.
    options
        Thresholds.
    """
    shared: list[Reason] = []
    found: dict[str, list[Reason]] = {}
    if drive is not None:
        shared += _on_drive(drive, options)
        for sensor in drive.sensors:
            found.setdefault(sensor.sensor, []).extend(_on_sensor(sensor, options))
        _add_missing(found, drive.missing)
    if comparison is not None:
        shared.append(Reason(Level.PASS, comparison.assumption))
        if comparison.same_bag:
            shared.append(Reason(Level.WARN, "One drive took part in both calibrations."))
        for each in comparison.sensors:
            found.setdefault(each.sensor, []).extend(_on_comparison(each, options))
        _add_missing(found, comparison.missing)
    sensors = tuple(_remarks(name, reasons) for name, reasons in found.items())
    levels = [worst(tuple(shared)), *(Level(each.level) for each in sensors)]
    whole = max(levels, key=lambda each: each.rank)
    return ValidationVerdict(whole.value, _ordered(shared), sensors)


def thresholds(options: QaOptions) -> tuple[Threshold, ...]:
    """Return where the verdict changes."""
    shared = [(name, options, name) for name in SHARED_LIMITS]
    own = [(f"validation.{name}", options.validation, name) for name, _ in options.validation]
    return tuple(
        Threshold(shown, limit.warn, limit.fail, type(model).model_fields[name].description or "")
        for shown, model, name in (*shared, *own)
        if isinstance(limit := getattr(model, name), Limit)
    )


def _remarks(sensor: str, reasons: list[Reason]) -> SensorRemarks:
    return SensorRemarks(sensor, worst(tuple(reasons)).value, _ordered(reasons))


def _ordered(reasons: list[Reason]) -> tuple[Remark, ...]:
    graver = sorted(reasons, key=lambda each: -each.level.rank)
    return tuple(Remark(each.level.value, each.text) for each in graver)


def _add_missing(found: dict[str, list[Reason]], missing: tuple[NotValidated, ...]) -> None:
    for each in missing:
        level = Level.FAIL if each.faulty else Level.WARN
        found.setdefault(each.sensor, []).append(Reason(level, each.reason))


def _on_drive(drive: DriveValidation, options: QaOptions) -> list[Reason]:
    """Return what concerns all sensors."""
    if drive.sensors and all(_misfit(each, options) for each in drive.sensors):
        text = (
            "The map does not fit this drive: a field that is the same everywhere explains the "
            "readings as well. Is it the map of this place, and are the poses in its frame? "
            "Nothing is said of the calibration."
        )
        return [Reason(Level.FAIL, text)]
    return [
        *(Reason(Level.WARN, each) for each in drive.doubts),
        *(Reason(Level.PASS, each) for each in drive.notes),
    ]


def _misfit(sensor: ValidatedSensor, options: QaOptions) -> bool:
    """Whether no C and H make the readings of a sensor follow the map."""
    above = level_of(sensor.unexplained, options.unexplained) is Level.FAIL
    return above and sensor.refitted > EXPECTED_TIMES * sensor.expected


def _on_sensor(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    if _misfit(sensor, options):
        text = (
            f"Whatever C and H are, the map leaves {sensor.refitted:.2g} µT of its readings, a "
            f"field that is the same everywhere {sensor.uniform:.2g} µT: the map does not fit what "
            "it reads here."
        )
        return [Reason(Level.FAIL, text)]
    rules: tuple[Callable[[ValidatedSensor, QaOptions], list[Reason]], ...] = (
        _changed,
        _consistent,
        _counted,
        _blind,
        _ending,
    )
    return [reason for rule in rules for reason in rule(sensor, options)]


def _changed(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    share = sensor.rejected / (sensor.readings + sensor.rejected)
    doubt = ""
    if level_of(share, options.rejected) is not Level.PASS:
        doubt = " (Readings were rejected, see below; what else differs near these pulls at this.)"
    return [
        _change(each, options, "On this drive {name} is not as calibrated, by {amount}", doubt)
        for each in sensor.changes
    ]


def _change(change: Change, options: QaOptions, text: str, doubt: str = "") -> Reason:
    """Return a change as a reason; one that nobody minds is only worth knowing."""
    level = level_of(change.size, limits_of(options.validation)[change.part])
    told = text.format(name=NAMES[change.part], amount=by_how_much(change))
    told = told[0].upper() + told[1:]
    if level is Level.PASS:
        return Reason(level, f"{told}: more than chance, but too little to mind.")
    return Reason(level, f"{told}: {MEANINGS[change.part]}.{doubt}")


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
    return against(sensor.nis.ratio, options.validation.nis, text)


def _counted(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    within = sensor.readings + sensor.rejected
    share, lost = sensor.rejected / within, sensor.outside / (within + sensor.outside)
    return [
        *against(
            share,
            options.rejected,
            f"{share:.0%} of its readings fit no calibration that explains the others and do not "
            "count: the place has changed there since it was mapped, or something passed by.",
        ),
        *against(
            lost,
            options.outside_map,
            f"{lost:.0%} of its readings lie outside the map and do not count.",
        ),
    ]


def _blind(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    """Return which changes the drive would not have shown."""
    limits, named = limits_of(options.validation), {each.part for each in sensor.changes}
    hidden = [
        f"{NAMES[each.part]} (a change of less than {amount(each.part, each.size)})"
        if np.isfinite(each.size)
        else f"{NAMES[each.part]} (however it changed)"
        for each in sensor.noticeable
        if each.part not in (*named, Part.CLOCK)
        and each.size > BLIND_TIMES * limits[each.part].fail
    ]
    if not hidden:
        return []
    text = f"This drive says too little of {', '.join(hidden)}: that would not show."
    return [Reason(Level.WARN, text)]


def _ending(sensor: ValidatedSensor, options: QaOptions) -> list[Reason]:
    if not sensor.ending:
        return []
    return [Reason(Level.WARN, f"Of its calibration: {sensor.ending.rstrip('.')}.")]


def _on_comparison(sensor: ComparedSensor, options: QaOptions) -> list[Reason]:
    """Return what has changed since the older calibration."""
    whole = sensor.test("all")
    if not whole.freedom:
        return [Reason(Level.WARN, "The two calibrations determine nothing of it in common.")]
    if sensor.changes:
        return [
            _change(each, options, "since the old calibration {name} has changed by {amount}")
            for each in sensor.changes
        ]
    if whole.chance < options.validation.chance / (len(NAMES)):
        times = (whole.chi_square / whole.freedom) ** 0.5
        text = (
            f"The two calibrations differ {times:.1f} times as much as their uncertainties allow, "
            "in no single part of it beyond chance: several parts have changed a little together."
        )
        return [Reason(Level.WARN, text)]
    return [Reason(Level.PASS, "No change since the old calibration beyond both uncertainties.")]

"""The verdict on a localisation: PASS, WARN or FAIL, with reasons in plain sentences."""

import numpy as np
from scipy.stats import chi2

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.judge import SensorVerdict, Verdict
from l2m_gtsam.qa.options import Limit, QaOptions, SlamQaOptions
from l2m_gtsam.qa.reasons.reason import Level, Reason, against, worst
from l2m_gtsam.qa.slam.course import Course, course_of
from l2m_gtsam.slam_records import LocalisationRecord, RefinedSensor, SensorRecord, TruthRecord
from l2m_gtsam.slam_results import LocalisationStatus
from l2m_gtsam.validation_results import Threshold

SHARED_LIMITS = ("rejected", "outside_map", "chi_square")


def judge_localisation(record: LocalisationRecord, options: QaOptions) -> Verdict:
    """Return the verdict with its reasons.

    A sensor that fails beside others that serve is a warning for the whole: the poses rest on the
    others.

    Parameters
    ----------
    record
        The localisation.
    options
        Thresholds.
    """
    shared = _ordered(
        [
            *_ending(record),
            *_precision(record, options.slam),
            *_steps(record, options.slam),
            *([] if record.truth is None else _truth(record.truth, options.slam)),
            *(Reason(Level.WARN, f"{each.rstrip('.')}.") for each in record.notes),
            *_sigmas(record),
            *_drift(record),
        ]
    )
    refined = {each.sensor: each for each in record.refined}
    sensors = tuple(
        _on_sensor(each, refined.get(each.use.sensor), options) for each in record.sensors
    )
    return Verdict(_whole(shared, sensors), shared, sensors)


def slam_thresholds(options: QaOptions) -> tuple[Threshold, ...]:
    """Return where the verdict changes."""
    shared = [(name, options, name) for name in SHARED_LIMITS]
    own = [(f"slam.{name}", options.slam, name) for name, _ in options.slam]
    return tuple(
        Threshold(shown, limit.warn, limit.fail, type(model).model_fields[name].description or "")
        for shown, model, name in (*shared, *own)
        if isinstance(limit := getattr(model, name), Limit)
    )


def _whole(shared: tuple[Reason, ...], sensors: tuple[SensorVerdict, ...]) -> Level:
    levels = [each.level for each in sensors]
    if any(each is not Level.FAIL for each in levels):
        levels = [min(each, Level.WARN, key=lambda level: level.rank) for each in levels]
    return max([worst(shared), *levels], key=lambda each: each.rank)


def _ordered(reasons: list[Reason]) -> tuple[Reason, ...]:
    return tuple(sorted(reasons, key=lambda each: -each.level.rank))


def _ending(record: LocalisationRecord) -> list[Reason]:
    message = record.message.rstrip(".")
    if record.status is LocalisationStatus.LOCALISED:
        return []
    if record.status is LocalisationStatus.NOT_CONVERGED:
        text = (
            f"The solve did not converge ({message}): poses may be further off than their standard "
            "deviations say. Allow more steps with slam.max_iterations."
        )
        return [Reason(Level.FAIL, text)]
    return [Reason(Level.FAIL, f"{message[:1].upper()}{message[1:]}.")]


def _precision(record: LocalisationRecord, options: SlamQaOptions) -> list[Reason]:
    """Return where poses are not known well."""
    course = course_of(record)
    if not np.isfinite(course.sigma).all():
        return [Reason(Level.WARN, "How sure the poses are is not known.")]
    position, heading = course.position_sigma, course.heading_sigma
    least, widest = options.position_sigma_m, options.heading_sigma_deg
    return [
        *against(
            float(position.max()),
            least,
            f"The position is known to no better than {1e3 * position.max():.0f} mm (1 sigma) at "
            f"worst, {_when(course, position)}, and to no better than {1e3 * least.warn:.0f} mm "
            f"for {_share(course, position, least)} of the way: the field tells too little of "
            "places there, or too few readings count.",
        ),
        *against(
            float(heading.max()),
            widest,
            f"The heading is known to no better than {heading.max():.1f}° (1 sigma) at worst, "
            f"{_when(course, heading)}, and to no better than {widest.warn:g}° for "
            f"{_share(course, heading, widest)} of the way.",
        ),
    ]


def _when(course: Course, values: FloatArray) -> str:
    k = int(np.argmax(values))
    return f"{course.way[k]:.0f} m from the start"


def _share(course: Course, values: FloatArray, limit: Limit) -> str:
    """Return over which share of the way values are above a limit: of steps, by their ends."""
    steps, whole = np.diff(course.way), course.way[-1]
    above = float(steps[values[1:] > limit.warn].sum()) / whole if whole > 0 else 1.0
    return f"{above:.0%}"


def _steps(record: LocalisationRecord, options: SlamQaOptions) -> list[Reason]:
    text = (
        f"Steps between the localised poses differ from odometry's by {record.steps:.1f} times the "
        "variance that it states: odometry is worse than it says (slam.drift), it jumped, or poses "
        "were bent until the readings fit."
    )
    return against(record.steps, options.steps, text)


def _truth(truth: TruthRecord, options: SlamQaOptions) -> list[Reason]:
    before, after = (1e3 * each.rms_m for each in (truth.odometry, truth.localised))
    errors = f"{before:.0f} mm rms of odometry alone, {after:.0f} mm localised"
    if after > before:
        # Odometry has no drift yet where a drive begins, if it begins where it is said to.
        text = f"Against the truth, localising made the error of the position larger: {errors}."
        reasons = [Reason(Level.WARN, text)]
    else:
        text = f"Against the truth, {truth.removed:.0%} of odometry's error is gone: {errors}."
        reasons = [Reason(Level.PASS, text)]
    text = (
        f"Against the truth, errors of the poses are {truth.nees_ratio**0.5:.1f} times as large as "
        f"their standard deviations say (NEES {truth.nees:.1f}; 6 is honest)."
    )
    return [*reasons, *against(truth.nees_ratio, options.nees, text)]


def _sigmas(record: LocalisationRecord) -> list[Reason]:
    """Return what standard deviations leave out."""
    reasons = []
    if not record.map_errors_shared:
        text = (
            "This kind of map does not say how its errors go together: they count as each "
            "reading's own, and standard deviations come out too small. A harmonic map says it."
        )
        reasons.append(Reason(Level.WARN, text))
    if not record.refined:
        text = "The calibration counts as exact: its uncertainty is not in the sigmas of poses."
        reasons.append(Reason(Level.PASS, text))
    return reasons


def _drift(record: LocalisationRecord) -> list[Reason]:
    drift = record.drift
    text = (
        f"Odometry alone would have ended {drift.end_m:.2f} m and {drift.end_deg:.1f}° from the "
        f"localised poses, {drift.end_share:.1%} of the way."
    )
    return [Reason(Level.PASS, text)]


def _on_sensor(
    sensor: SensorRecord, refined: RefinedSensor | None, options: QaOptions
) -> SensorVerdict:
    reasons = _ordered([*_counted(sensor, options), *_refined(refined, options.slam)])
    return SensorVerdict(sensor.use.sensor, worst(reasons), reasons)


def _counted(sensor: SensorRecord, options: QaOptions) -> list[Reason]:
    use = sensor.use
    if not use.used:
        return [Reason(Level.FAIL, f"None of its {use.readings:,} readings counts.")]
    inside = use.readings - use.outside_map
    wrong, lost = use.rejected / inside, use.outside_map / use.readings
    return [
        *against(
            wrong,
            options.rejected,
            f"{wrong:.0%} of its readings inside the map do not fit it where the others say that "
            "the vehicle was, and do not count: the place has changed since it was mapped, "
            "something passed by, or the sensor is no longer as calibrated.",
        ),
        *against(
            lost,
            options.outside_map,
            f"{lost:.0%} of its readings lie outside the map and do not count.",
        ),
        *against(
            use.chi2_per_dof,
            options.chi_square,
            f"Its residuals are {use.chi2_per_dof**0.5:.1f} times as large as noise and map lead "
            "to expect: it is noisier or no longer as calibrated, or the map is less exact than "
            "it states.",
        ),
    ]


def _refined(refined: RefinedSensor | None, options: SlamQaOptions) -> list[Reason]:
    """Return that a calibration was not as sure as it said."""
    if refined is None:
        return []
    change = refined.change
    if chi2.sf(change.value, change.freedom) >= options.chance:
        return []
    text = (
        f"Refining it changed it by more than its standard deviations allow ({change.value:.0f} "
        f"for {change.freedom} parameters, normalised and squared): it has changed since it was "
        "calibrated, or its covariance was too small."
    )
    return [Reason(Level.WARN, text)]

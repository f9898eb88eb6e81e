"""The verdict on a localisation: PASS, WARN or FAIL, with reasons in plain sentences."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.metrics.trajectory import HEADING, LocalisedTrajectory, localised_trajectory
from l2m_gtsam.qa.options import Limit, QaOptions, SlamQaOptions, thresholds
from l2m_gtsam.qa.verdict.reasons import failure, note, warning
from l2m_gtsam.qa.verdict.sensor import outside_map
from l2m_gtsam.records.localisation import (
    LocalisationStatus,
    OdometryScale,
    OdometryTurn,
    ScanUse,
)
from l2m_gtsam.records.localisation_file import (
    POSE_FREEDOM,
    LocalisationRecord,
    RefinedSensor,
    SensorRecord,
    TruthRecord,
)
from l2m_gtsam.records.verdict import Judgement, Level, Reason, SensorVerdict, Threshold, Verdict
from l2m_gtsam.solve.chi_square import chance_beyond
from l2m_gtsam.text import with_sigma

SHARED_LIMITS = ("rejected", "outside_map", "chi_square")
MANY = 3  # stretches that are listed one by one
EXACT = 1e-6  # m and degrees: smaller standard deviations count as this
MOST = 0.5  # share of a sensor's readings in a span of the timeline


@dataclass(frozen=True)
class FieldWording:
    """How sentences speak of the field that readings are compared with.

    Attributes
    ----------
    compared
        Which readings do not fit it.
    expected
        What it is called.
    changed
        Why readings may fit no place.
    inexact
        Why it may fit less well than it states.
    """

    compared: str
    expected: str
    changed: str
    inexact: str


IN_MAP = FieldWording(
    compared="of its readings inside the map do not fit it",
    expected="map",
    changed="the place has changed since it was mapped, or something passed by",
    inexact="the map is less exact than it states",
)
WITHOUT_MAP = FieldWording(
    compared="of its readings do not fit the field of the others",
    expected="the estimated field",
    changed="steel was moved during the drive, or something passed by",
    inexact="its noise is stated too small",
)


def judge_localisation(record: LocalisationRecord, options: QaOptions) -> Verdict:
    """Return the verdict with its reasons.

    A sensor that fails beside others that serve is a warning for the whole: the poses rest on the
    others.

    Parameters
    ----------
    options
        Thresholds.
    """
    refined = {each.sensor: each for each in record.refined}
    sensors = [
        SensorVerdict.of(
            each.use.sensor,
            [
                *_counted(each, options, _wording(record)),
                *_refined(refined.get(each.use.sensor), options.slam),
            ],
        )
        for each in record.sensors
    ]
    served = any(each.level is not Level.FAIL for each in sensors)
    return Verdict.of(
        _shared_reasons(record, options.slam), sensors, Level.WARN if served else Level.FAIL
    )


def judgement_of_localisation(record: LocalisationRecord, options: QaOptions) -> Judgement:
    """Return the verdict with its thresholds, and what was judged before by other thresholds.

    Parameters
    ----------
    record, options
        As of `judge_localisation`.
    """
    used = options.model_dump(mode="json", exclude={"validation"})
    return Judgement.of(judge_localisation(record, options), used, record.judgement)


def localisation_thresholds(options: QaOptions) -> tuple[Threshold, ...]:
    """Return where the verdict changes."""
    return thresholds(options, SHARED_LIMITS) + thresholds(options.slam, prefix="slam.")


def _shared_reasons(record: LocalisationRecord, options: SlamQaOptions) -> list[Reason]:
    """Return what concerns all sensors: ending, poses, odometry, place and truth."""
    path = localised_trajectory(record)
    return [
        *_ending(record),
        *_precision(path, options),
        *_start(path, options),
        *_steps(record, options),
        *([] if record.scans is None else _scans(record.scans, options)),
        *([] if record.truth is None else _truth(record.truth, options)),
        *_changed(record, path),
        *(Reason(Level.WARN, f"{each.rstrip('.')}.") for each in record.notes),
        *_sigmas(record),
        *(Reason(Level.PASS, each) for each in record.hints),
        *_drift(record),
        *([] if record.scale is None else _scale(record.scale)),
        *([] if record.turn is None else _turn(record.turn)),
    ]


def _ending(record: LocalisationRecord) -> list[Reason]:
    message = record.message.rstrip(".")
    if record.status is LocalisationStatus.LOCALISED:
        return []
    if record.status is LocalisationStatus.NOT_CONVERGED:
        return failure(
            f"The solve did not converge ({message}): errors of poses may exceed their standard "
            "deviations. Allow more steps with slam.max_iterations."
        )
    return failure(f"{message[:1].upper()}{message[1:]}.")


def _precision(path: LocalisedTrajectory, options: SlamQaOptions) -> list[Reason]:
    """Return where poses are not known well."""
    if not np.isfinite(path.sigma).all():
        return warning("The uncertainty of the poses is not known.")
    position, heading = path.position_sigma, path.heading_sigma
    least, widest = options.position_sigma_m, options.heading_sigma_deg
    return [
        *least.reasons(
            float(position.max()),
            f"The position is known to no better than {1e3 * position.max():.0f} mm (1 sigma) at "
            f"worst, {_where(path, position)}, and to no better than {1e3 * least.warn:.0f} mm "
            f"for {_share(path, position, least)} of the path: the field there varies too little "
            "to determine positions, or too few readings count.",
        ),
        *widest.reasons(
            float(heading.max()),
            f"The heading is known to no better than {heading.max():.1f}° (1 sigma) at worst, "
            f"{_where(path, heading)}, and to no better than {widest.warn:g}° for "
            f"{_share(path, heading, widest)} of the path.",
        ),
    ]


def _where(path: LocalisedTrajectory, values: FloatArray) -> str:
    """Return where values, shape (K,), are largest."""
    return f"{path.distance[int(np.argmax(values))]:.0f} m from the start"


def _share(path: LocalisedTrajectory, values: FloatArray, limit: Limit) -> str:
    """Return over which share of the path values, shape (K,), warn: of steps, by their ends."""
    steps, whole = np.diff(path.distance), path.distance[-1]
    above = float(steps[values[1:] > limit.warn].sum()) / whole if whole > 0 else 1.0
    return f"{above:.0%}"


def _start(path: LocalisedTrajectory, options: SlamQaOptions) -> list[Reason]:
    """Return that a drive does not begin at the start that was given."""
    position, heading = np.maximum(path.odometry_sigma[0, [0, HEADING]], EXACT)
    squared = (path.apart[0] / position) ** 2 + (path.turned[0] / heading) ** 2
    # Distance and angle are of three coordinates each: chi-square of six.
    if chance_beyond(squared, POSE_FREEDOM) >= options.chance:
        return []
    return warning(
        f"The drive begins {path.apart[0]:.2f} m and {path.turned[0]:.1f}° from the given start, "
        "more than slam.start allows: a wrong start, or a map or calibration that is off."
    )


def _steps(record: LocalisationRecord, options: SlamQaOptions) -> list[Reason]:
    text = (
        f"Steps between the localised poses differ from odometry's by {record.steps:.1f} times the "
        "variance that it states: odometry is worse than stated (slam.drift), it jumped, or poses "
        "were bent until the readings fit."
    )
    return options.steps.reasons(record.steps, text)


def _scans(scans: ScanUse, options: SlamQaOptions) -> list[Reason]:
    """Return where scans contradict each other or the rest."""
    whole = scans.fixes + scans.loops + scans.rejected
    text = (
        f"{scans.rejected} of {whole} scan registrations were rejected: they contradict "
        "odometry and the others."
    )
    fit = (
        f"Poses differ from those of the scans by {scans.chi2_per_dof:.1f} times the variance "
        "that these state: readings and scans disagree about places."
    )
    some = options.scans.reasons(scans.rejected / whole, text) if scans.rejected else []
    return [*some, *options.steps.reasons(scans.chi2_per_dof, fit)]


def _truth(truth: TruthRecord, options: SlamQaOptions) -> list[Reason]:
    before, after = (1e3 * each.rms_m for each in (truth.odometry, truth.localised))
    errors = f"{before:.0f} mm rms of odometry alone, {after:.0f} mm localised"
    if after > before:
        # Odometry has not drifted yet at the start, if that is known.
        text = f"Against the truth, localising made the error of the position larger: {errors}."
        first = warning(text)
    else:
        removed = truth.removed  # not a number where odometry is the truth itself
        gone = "" if np.isnan(removed) else f"{removed:.0%} of odometry's error is gone: "
        first = note(f"Against the truth, {gone}{errors}.")
    text = (
        f"Against the truth, errors of the poses are {truth.nees_ratio**0.5:.1f} times their "
        f"standard deviations (NEES {truth.nees:.1f}; consistent: expected {POSE_FREEDOM})."
    )
    return [*first, *options.nees.reasons(truth.nees_ratio, text)]


def _changed(record: LocalisationRecord, path: LocalisedTrajectory) -> list[Reason]:
    """Return where no sensor fits the map."""
    found = stretches(record.sensors)
    reasons = []
    for start, end in found[:MANY]:
        here, there = ("({:.1f}, {:.1f})".format(*path.place_at(each)) for each in (start, end))
        reasons += warning(
            f"From {start:.0f} to {end:.0f} s, between {here} and {there} m, most "
            "readings of all sensors fit no place where the vehicle can have been: "
            f"{_wording(record).changed}."
        )
    if len(found) > MANY:
        reasons += warning(f"The same is true of {len(found) - MANY} more stretches.")
    return reasons


def stretches(sensors: Sequence[SensorRecord]) -> list[tuple[float, float]]:
    """Return from when to when most readings of every sensor inside the map were rejected.

    Times are in seconds since the first key pose. One sensor alone cannot distinguish a place that
    has changed from a fault of its own: then there are none.
    """
    serving = [each for each in sensors if each.use.used]
    if len(serving) < 2:
        return []
    wrong = np.array([each.timeline.rejected for each in serving])
    inside = wrong + np.array([each.timeline.used for each in serving])
    read = np.flatnonzero(inside.sum(axis=0))  # spans between key poses hold nothing
    # A sensor without a reading there is no evidence against it.
    all_wrong = np.all(wrong[:, read] >= MOST * inside[:, read], axis=0)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], all_wrong, [False]])))
    edges = serving[0].timeline.edges
    return [(edges[read[first]], edges[read[last - 1] + 1]) for first, last in ends.reshape(-1, 2)]


def _sigmas(record: LocalisationRecord) -> list[Reason]:
    """Return what standard deviations leave out."""
    reasons = []
    if not record.map_errors_shared:
        reasons += warning(
            "This kind of map does not state how its errors are correlated: they count as each "
            "reading's own, and standard deviations come out too small. A harmonic map states it."
        )
    if not record.refined:
        reasons += note(
            "The calibration is fixed (`slam.calibration`): its own sigmas, stated or assumed, are "
            "not in those of the poses."
        )
    return reasons


def _drift(record: LocalisationRecord) -> list[Reason]:
    drift = record.drift
    return note(
        f"Odometry alone would have ended {drift.end_m:.2f} m and {drift.end_deg:.1f}° from the "
        f"localised poses, {drift.end_share:.1%} of the path."
    )


def _scale(scale: OdometryScale) -> list[Reason]:
    return note(
        f"Distances are {with_sigma(100 * abs(scale.longer), 100 * scale.sigma, '%')} (1 sigma) "
        f"{'longer' if scale.longer >= 0 else 'shorter'} than odometry's."
    )


def _turn(turn: OdometryTurn) -> list[Reason]:
    return note(
        f"Odometry turns by {with_sigma(abs(turn.left_deg_per_m), turn.sigma, 'deg')} (1 sigma) "
        f"per metre too far to the {'left' if turn.left_deg_per_m >= 0 else 'right'}, all along "
        "the drive."
    )


def _wording(record: LocalisationRecord) -> FieldWording:
    return IN_MAP if record.explored is None else WITHOUT_MAP


def _counted(sensor: SensorRecord, options: QaOptions, words: FieldWording) -> list[Reason]:
    """Return which readings of a sensor do not count, and how the others fit."""
    use = sensor.use
    if not use.used:
        return failure(f"None of its {use.readings:,} readings counts.")
    inside = use.readings - use.outside_map
    wrong, lost = use.rejected / inside, use.outside_map / use.readings
    return [
        *options.rejected.reasons(
            wrong,
            f"{wrong:.0%} {words.compared} where the others place the vehicle, and do not count: "
            f"{words.changed}, or the sensor is no longer as calibrated.",
        ),
        *outside_map(lost, options),
        *options.chi_square.reasons(
            use.chi2_per_dof,
            f"Its residuals are {use.chi2_per_dof**0.5:.1f} times as large as noise and "
            f"{words.expected} lead to expect: it is noisier or no longer as calibrated, or "
            f"{words.inexact}.",
        ),
    ]


def _refined(refined: RefinedSensor | None, options: SlamQaOptions) -> list[Reason]:
    """Return that a calibration was less exact than it stated."""
    if refined is None:
        return []
    change = refined.change
    if chance_beyond(change.value, change.freedom) >= options.chance:
        return []
    return warning(
        f"Refining it changed it by more than its standard deviations allow ({change.value:.0f} "
        f"for {change.freedom} parameters, normalised and squared): it has changed since it was "
        "calibrated, or its covariance was too small."
    )

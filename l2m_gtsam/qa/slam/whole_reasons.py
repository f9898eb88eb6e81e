"""What is said of a localisation as a whole, a plain sentence each."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.options import Limit, SlamQaOptions
from l2m_gtsam.qa.reasons.reason import Level, Reason, against
from l2m_gtsam.qa.slam.course import HEADING, Course, course_of
from l2m_gtsam.qa.slam.stretches import stretches
from l2m_gtsam.records.localisation import LocalisationStatus, OdometryScale, ScanUse
from l2m_gtsam.records.localisation_file import POSE_FREEDOM, LocalisationRecord, TruthRecord
from l2m_gtsam.solve.chi_square import chance_beyond

MANY = 3  # stretches that are told one by one
EXACT = 1e-6  # m and degrees: nobody minds less


def on_whole(record: LocalisationRecord, options: SlamQaOptions) -> list[Reason]:
    """Return what concerns all sensors: ending, poses, odometry, place and truth."""
    course = course_of(record)
    return [
        *_ending(record),
        *_precision(course, options),
        *_start(course, options),
        *_steps(record, options),
        *([] if record.scans is None else _scans(record.scans, options)),
        *([] if record.truth is None else _truth(record.truth, options)),
        *_changed(record, course),
        *(Reason(Level.WARN, f"{each.rstrip('.')}.") for each in record.notes),
        *_sigmas(record),
        *_drift(record),
        *([] if record.scale is None else _scale(record.scale)),
    ]


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


def _precision(course: Course, options: SlamQaOptions) -> list[Reason]:
    """Return where poses are not known well."""
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


def _start(course: Course, options: SlamQaOptions) -> list[Reason]:
    """Return that a drive does not begin where it is said to."""
    position, heading = np.maximum(course.odometry_sigma[0, [0, HEADING]], EXACT)
    squared = (course.apart[0] / position) ** 2 + (course.turned[0] / heading) ** 2
    if chance_beyond(squared, POSE_FREEDOM) >= options.chance:
        return []
    text = (
        f"The drive begins {course.apart[0]:.2f} m and {course.turned[0]:.1f}° from where it is "
        "said to, more than slam.start allows: a wrong start, or a map or calibration that is off."
    )
    return [Reason(Level.WARN, text)]


def _changed(record: LocalisationRecord, course: Course) -> list[Reason]:
    """Return where no sensor fits the map."""
    found = stretches(record.sensors)
    reasons = []
    for start, end in found[:MANY]:
        here, there = ("({:.1f}, {:.1f})".format(*course.place_at(each)) for each in (start, end))
        text = (
            f"From {start:.0f} to {end:.0f} s, between {here} and {there} m, most "
            "readings of all sensors fit no place where the vehicle can have been: the place "
            "has changed since it was mapped, or something passed by."
        )
        reasons.append(Reason(Level.WARN, text))
    if len(found) > MANY:
        more = f"The same is true of {len(found) - MANY} more stretches."
        reasons.append(Reason(Level.WARN, more))
    return reasons


def _steps(record: LocalisationRecord, options: SlamQaOptions) -> list[Reason]:
    text = (
        f"Steps between the localised poses differ from odometry's by {record.steps:.1f} times the "
        "variance that it states: odometry is worse than it says (slam.drift), it jumped, or poses "
        "were bent until the readings fit."
    )
    return against(record.steps, options.steps, text)


def _scans(scans: ScanUse, options: SlamQaOptions) -> list[Reason]:
    """Return where scans and the rest do not go together."""
    whole = scans.fixes + scans.loops + scans.rejected
    text = (
        f"{scans.rejected} of {whole} scan registrations were not believed: they contradict "
        "odometry and the others."
    )
    fit = (
        f"Poses differ from what scans say of them by {scans.chi2_per_dof:.1f} times the variance "
        "that these state: readings and scans disagree about places."
    )
    some = [] if not scans.rejected else against(scans.rejected / whole, options.scans, text)
    return [*some, *against(scans.chi2_per_dof, options.steps, fit)]


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


def _scale(scale: OdometryScale) -> list[Reason]:
    text = (
        f"Ways are {abs(scale.longer):.2%} ± {scale.sigma:.2%} (1 sigma) "
        f"{'longer' if scale.longer >= 0 else 'shorter'} than odometry has them."
    )
    return [Reason(Level.PASS, text)]

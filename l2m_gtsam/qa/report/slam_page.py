"""The page of a localisation: one file that needs nothing else, drawn from its record."""

import json
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np

from l2m_gtsam.qa.judge import SensorVerdict
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.figures import course as of_sensor
from l2m_gtsam.qa.report.figures import localisation as figures
from l2m_gtsam.qa.report.figures import place, statistics
from l2m_gtsam.qa.report.page import environment, style
from l2m_gtsam.qa.report.sections import Picture, picture
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.slam.course import Course, course_of
from l2m_gtsam.qa.slam.judge import judge_localisation, slam_thresholds
from l2m_gtsam.records.localisation_file import (
    LocalisationRecord,
    RefinedSensor,
    SensorRecord,
    TruthRecord,
)
from l2m_gtsam.solve.rank import PARAMETERS


@dataclass(frozen=True)
class SlamSection:
    """What the page shows of one sensor.

    Attributes
    ----------
    anchor
        Name of the section in the page.
    sensor, verdict
        Its figures and the verdict on it.
    refined
        Its calibration before and after; absent where it was fixed.
    pictures
        In the order of the page.
    """

    anchor: str
    sensor: SensorRecord
    verdict: SensorVerdict
    refined: RefinedSensor | None
    pictures: tuple[Picture, ...]


def slam_page(record: LocalisationRecord, options: QaOptions) -> str:
    """Return the report on a localisation as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.

    Parameters
    ----------
    record
        The localisation.
    options
        Thresholds of the verdict.
    """
    verdict, course = judge_localisation(record, options), course_of(record)
    refined = {each.sensor: each for each in record.refined}
    with mpl.rc_context(SETTINGS):
        way = _way(record, course)
        sections = [
            _section(k, sensor, each, refined.get(sensor.use.sensor))
            for k, (sensor, each) in enumerate(zip(record.sensors, verdict.sensors, strict=True))
        ]
    template = environment().get_template("slam.html.j2")
    return template.render(
        record=record,
        verdict=verdict,
        course=course,
        median=1e3 * float(np.median(course.position_sigma)),
        way=way,
        sections=sections,
        limits=slam_thresholds(options),
        parameters=PARAMETERS,
        options=json.dumps(record.options, indent=2, ensure_ascii=False),
        style=style(),
    )


def _way(record: LocalisationRecord, course: Course) -> tuple[Picture, ...]:
    """Return pictures of the whole drive."""
    pictures = [_over_the_map(record, course), _sigmas(course), _drift(record, course)]
    if record.truth is not None:
        pictures.insert(1, _errors(record.truth, course))
    return (*pictures, *_counted(record, course))


def _over_the_map(record: LocalisationRecord, course: Course) -> Picture:
    drift, truth = record.drift, record.truth
    scale = figures.ellipse_scale(course, record.picture)
    size = f"drawn {scale} times as large" if scale > 1 else "as large as they are"
    return picture(
        "The way in the map",
        figures.way_figure(course, record.picture, None if truth is None else truth.path),
        "way",
        f"The localised way of {drift.way_m:.1f} m over the map's field strength, beside that of "
        f"odometry alone{' and the truth' if truth else ''}.",
        f"Ellipses: one sigma of the position, {size}. Odometry alone ends {drift.end_m:.2f} m "
        "from the localised way.",
    )


def _sigmas(course: Course) -> Picture:
    position, alone = course.position_sigma, course.odometry_sigma[:, :3].max(axis=1)
    heading = course.heading_sigma
    return picture(
        "How sure the poses are",
        figures.sigma_figure(course),
        "sigmas",
        f"Standard deviations over time: position {1e3 * position.max():.0f} mm at most, heading "
        f"{heading.max():.2f}° at most; odometry alone {1e3 * alone[-1]:.0f} mm at the end.",
        f"At the end odometry alone would be known to {1e3 * alone[-1]:.0f} mm, with the map it is "
        f"{1e3 * position[-1]:.0f} mm: what the readings are worth. Worst on the way: "
        f"{1e3 * position.max():.0f} mm and {heading.max():.2f}°.",
    )


def _drift(record: LocalisationRecord, course: Course) -> Picture:
    drift = record.drift
    return picture(
        "Drift of odometry",
        figures.drift_figure(course),
        "drift",
        f"Distance of odometry alone from the localised poses over the way: {drift.end_m:.2f} m at "
        f"the end, {drift.largest_m:.2f} m at most.",
        f"{drift.end_m:.2f} m and {drift.end_deg:.1f}° at the end ({drift.end_share:.1%} of the "
        f"way), {drift.largest_m:.2f} m at most. A jump is a wheel that slipped, or a wrong match.",
    )


def _errors(truth: TruthRecord, course: Course) -> Picture:
    before, after = truth.odometry, truth.localised
    return picture(
        "Errors against the truth",
        figures.truth_figure(course, truth),
        "errors",
        f"Position errors against the truth: odometry {1e3 * before.rms_m:.0f} mm rms, localised "
        f"{1e3 * after.rms_m:.0f} mm rms.",
        f"{1e3 * before.rms_m:.0f} mm rms before, {1e3 * after.rms_m:.0f} mm after. Dots above the "
        f"band, {truth.beyond_95:.0%} of them (5 % is honest), are errors that covariances do not "
        "allow.",
    )


def _counted(record: LocalisationRecord, course: Course) -> tuple[Picture, ...]:
    uses = [each.use for each in record.sensors]
    wrong, whole = sum(each.rejected for each in uses), sum(each.readings for each in uses)
    told = f"{wrong:,} of {whole:,} readings are rejected"
    return (
        picture(
            "Which readings count",
            figures.counted_figure(record.sensors),
            "counted",
            f"Shares of readings that count over time, a row per sensor: {told}.",
            f"{told}. Red in all rows is a place that has changed or something that passed by; "
            "in one row it is that sensor.",
        ),
        picture(
            "Where readings were rejected",
            figures.rejected_figure(course, record.sensors),
            "rejected",
            f"The way of the lidar and where readings were rejected: {told}.",
            "Crosses that keep together, also when the place is passed again, are a place that "
            "differs from the map.",
        ),
    )


def _section(
    index: int, sensor: SensorRecord, verdict: SensorVerdict, refined: RefinedSensor | None
) -> SlamSection:
    anchor = f"sensor-{index}"
    pictures = [*_of_readings(anchor, sensor), *([] if refined is None else [_of(anchor, refined)])]
    return SlamSection(anchor, sensor, verdict, refined, tuple(pictures))


def _of_readings(anchor: str, sensor: SensorRecord) -> list[Picture]:
    name, series, normalised = sensor.use.sensor, sensor.series, sensor.normalised
    if series is None or normalised is None:
        return []
    std = ", ".join(f"{each:.2f}" for each in normalised.std)
    return [
        picture(
            "Corrected readings and the map",
            of_sensor.curves_figure(series),
            f"{anchor}-curves",
            f"Readings of {name} along the lidar's axes, as read and corrected, beside the map's "
            "at the localised poses.",
            "The dashed line should lie on the broad one all along the way.",
        ),
        picture(
            "Residuals over time",
            of_sensor.residuals_figure(series),
            f"{anchor}-residuals",
            f"Residuals of {name} over time: {sensor.use.rms:.2g} µT rms per axis.",
            f"Should look like noise around zero: {sensor.use.rms:.2g} µT rms per axis. Crosses "
            "do not count.",
        ),
        picture(
            "Normalised residuals",
            statistics.chi_square_figure(normalised),
            f"{anchor}-chi2",
            f"Squared normalised residuals of {name} beside chi-square: standard deviations {std} "
            f"along x, y, z, {normalised.beyond_95:.1%} beyond the 95 % quantile.",
            f"Bars on the dashed line: noise and map are as stated. Standard deviations {std} (1 "
            "is consistent).",
        ),
        picture(
            "Residuals over the map",
            place.residual_figure(series),
            f"{anchor}-place",
            f"Length of the residuals of {name} where they were read.",
            "Bright spots that keep together are places where map and readings disagree.",
        ),
    ]


def _of(anchor: str, refined: RefinedSensor) -> Picture:
    difference = tuple(np.subtract(refined.after, refined.before))
    change = refined.change
    return picture(
        "Refined less before",
        statistics.sigmas_figure(difference, refined.sigma_before, "change (sigmas of before)"),
        f"{anchor}-refined",
        f"Change of each parameter of {refined.sensor} in standard deviations of the calibration "
        f"before: {change.value:.1f} together.",
        f"Together {change.value:.1f}; of a calibration as exact as stated it is less than "
        f"{change.high:.1f} in 97.5 % of all cases.",
    )

"""The page of a localisation: one file that needs nothing else, drawn from its record."""

import json
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np

from l2m_gtsam.qa.metrics.trajectory import LocalisedTrajectory, localised_trajectory
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.figures import localisation as figures
from l2m_gtsam.qa.report.figures import readings, statistics
from l2m_gtsam.qa.report.page import (
    Picture,
    normalised_picture,
    picture,
    render,
    residual_map_picture,
)
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.verdict.localisation import judge_localisation, localisation_thresholds
from l2m_gtsam.records.localisation_file import (
    LocalisationRecord,
    RefinedSensor,
    SensorRecord,
    TruthRecord,
)
from l2m_gtsam.records.verdict import SensorVerdict
from l2m_gtsam.solve.rank import PARAMETERS


@dataclass(frozen=True)
class LocalisationSection:
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


def localisation_page(record: LocalisationRecord, options: QaOptions) -> str:
    """Return the report on a localisation as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.

    Parameters
    ----------
    record
        The localisation.
    options
        Thresholds of the verdict.
    """
    verdict, path = judge_localisation(record, options), localised_trajectory(record)
    refined = {each.sensor: each for each in record.refined}
    with mpl.rc_context(SETTINGS):
        pictures = _overall(record, path)
        sections = [
            _section(k, sensor, each, refined.get(sensor.use.sensor))
            for k, (sensor, each) in enumerate(zip(record.sensors, verdict.sensors, strict=True))
        ]
    return render(
        "localisation.html.j2",
        record=record,
        verdict=verdict,
        path=path,
        median=1e3 * float(np.median(path.position_sigma)),
        pictures=pictures,
        sections=sections,
        thresholds=localisation_thresholds(options),
        parameters=PARAMETERS,
        options=json.dumps(record.options, indent=2, ensure_ascii=False),
    )


def _overall(record: LocalisationRecord, path: LocalisedTrajectory) -> tuple[Picture, ...]:
    """Return pictures of the whole drive."""
    pictures = [_over_the_map(record, path), _sigmas(path), _drift(record, path)]
    if record.truth is not None:
        pictures.insert(1, _errors(record.truth, path))
    return (*pictures, *_counted(record, path))


def _over_the_map(record: LocalisationRecord, path: LocalisedTrajectory) -> Picture:
    drift, truth = record.drift, record.truth
    scale = figures.ellipse_scale(path, record.picture)
    size = f"drawn {scale} times as large" if scale > 1 else "as large as they are"
    return picture(
        "The path in the map",
        figures.path_figure(path, record.picture, None if truth is None else truth.path),
        "path",
        f"The localised path of {drift.way_m:.1f} m over the map's field strength, beside that of "
        f"odometry alone{' and the truth' if truth else ''}.",
        f"Ellipses: one sigma of the position, {size}. Odometry alone ends {drift.end_m:.2f} m "
        "from the localised path.",
    )


def _sigmas(path: LocalisedTrajectory) -> Picture:
    position, alone = path.position_sigma, path.odometry_sigma[:, :3].max(axis=1)
    heading = path.heading_sigma
    return picture(
        "Standard deviations of poses",
        figures.sigma_figure(path),
        "sigmas",
        f"Standard deviations over time: position {1e3 * position.max():.0f} mm at most, heading "
        f"{heading.max():.2f}° at most; odometry alone {1e3 * alone[-1]:.0f} mm at the end.",
        f"At the end odometry alone would be known to {1e3 * alone[-1]:.0f} mm, with the map it is "
        f"{1e3 * position[-1]:.0f} mm: what the readings are worth. At worst: "
        f"{1e3 * position.max():.0f} mm and {heading.max():.2f}°.",
    )


def _drift(record: LocalisationRecord, path: LocalisedTrajectory) -> Picture:
    drift = record.drift
    return picture(
        "Drift of odometry",
        figures.drift_figure(path),
        "drift",
        f"Distance of odometry alone from the localised poses along the path: {drift.end_m:.2f} m "
        f"at the end, {drift.largest_m:.2f} m at most.",
        f"{drift.end_m:.2f} m and {drift.end_deg:.1f}° at the end ({drift.end_share:.1%} of "
        f"the path), {drift.largest_m:.2f} m at most. A jump is a wheel that slipped, or a wrong "
        "match.",
    )


def _errors(truth: TruthRecord, path: LocalisedTrajectory) -> Picture:
    before, after = truth.odometry, truth.localised
    return picture(
        "Errors against the truth",
        figures.truth_figure(path, truth),
        "errors",
        f"Position errors against the truth: odometry {1e3 * before.rms_m:.0f} mm rms, localised "
        f"{1e3 * after.rms_m:.0f} mm rms.",
        f"{1e3 * before.rms_m:.0f} mm rms before, {1e3 * after.rms_m:.0f} mm after. Dots above the "
        f"band, {truth.beyond_95:.0%} of them (consistent: expected 5 %), are errors that "
        "covariances do not allow.",
    )


def _counted(record: LocalisationRecord, path: LocalisedTrajectory) -> tuple[Picture, ...]:
    uses = [each.use for each in record.sensors]
    wrong, whole = sum(each.rejected for each in uses), sum(each.readings for each in uses)
    rejected = f"{wrong:,} of {whole:,} readings are rejected"
    return (
        picture(
            "Which readings count",
            figures.counted_figure(record.sensors),
            "counted",
            f"Shares of readings that count over time, a row per sensor: {rejected}.",
            f"{rejected}. Red in all rows is a place that has changed or something that passed by; "
            "in one row it is that sensor.",
        ),
        picture(
            "Where readings were rejected",
            figures.rejected_figure(path, record.sensors),
            "rejected",
            f"The path of the lidar and where readings were rejected: {rejected}.",
            "Crosses that keep together, also when the place is passed again, are a place that "
            "differs from the map.",
        ),
    )


def _section(
    index: int, sensor: SensorRecord, verdict: SensorVerdict, refined: RefinedSensor | None
) -> LocalisationSection:
    anchor = f"sensor-{index}"
    pictures = [*_of_readings(anchor, sensor), *([] if refined is None else [_of(anchor, refined)])]
    return LocalisationSection(anchor, sensor, verdict, refined, tuple(pictures))


def _of_readings(anchor: str, sensor: SensorRecord) -> list[Picture]:
    name, series, normalised = sensor.use.sensor, sensor.series, sensor.normalised
    if series is None or normalised is None:
        return []
    return [
        picture(
            "Corrected readings and the map",
            readings.curves_figure(series),
            f"{anchor}-curves",
            f"Readings of {name} along the lidar's axes, as read and corrected, beside the map's "
            "at the localised poses.",
            "The dashed line should lie on the broad one all along the path.",
        ),
        picture(
            "Residuals over time",
            readings.residuals_figure(series),
            f"{anchor}-residuals",
            f"Residuals of {name} over time: {sensor.use.rms:.2g} µT rms per axis.",
            f"Should look like noise around zero: {sensor.use.rms:.2g} µT rms per axis. Crosses "
            "do not count.",
        ),
        normalised_picture(anchor, name, normalised, "noise and map are as stated"),
        residual_map_picture(anchor, name, series),
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

"""The page of a localisation: one file that needs nothing else, drawn from its record."""

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.qa.metrics.trajectory import LocalisedTrajectory, localised_trajectory
from l2m_gtsam.qa.options import QaOptions
from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.figures import localisation as drive_figures
from l2m_gtsam.qa.report.figures import readings, statistics
from l2m_gtsam.qa.report.page import Identity, Picture, pictures, render
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.verdict.localisation import judge_localisation, localisation_thresholds
from l2m_gtsam.records.localisation_file import LocalisationRecord, RefinedSensor, SensorRecord
from l2m_gtsam.records.verdict import SensorVerdict
from l2m_gtsam.storage.yaml_file import yaml_text


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
        By their keys.
    """

    anchor: str
    sensor: SensorRecord
    verdict: SensorVerdict
    refined: RefinedSensor | None
    pictures: dict[str, Picture]


def localisation_page(record: LocalisationRecord, options: QaOptions, identity: Identity) -> str:
    """Return the report on a localisation as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.

    Parameters
    ----------
    options
        Thresholds of the verdict.
    identity
        Of the file that it was written to.
    """
    verdict, path = judge_localisation(record, options), localised_trajectory(record)
    refined = {each.sensor: each for each in record.refined}
    with mpl.rc_context(SETTINGS):
        figures = pictures(_figures(record, path))
        sections = [
            _section(k, sensor, each, refined.get(sensor.use.sensor))
            for k, (sensor, each) in enumerate(zip(record.sensors, verdict.sensors, strict=True))
        ]
        return render(
            "localisation.html.j2",
            record=record,
            identity=identity,
            verdict=verdict,
            path=path,
            median=1e3 * float(np.median(path.position_sigma)),
            alone=1e3 * float(path.odometry_sigma[-1, :3].max()),
            scale=drive_figures.ellipse_scale(path, record.picture),
            pictures=figures,
            sections=sections,
            thresholds=localisation_thresholds(options),
            options=yaml_text(record.options, ""),
        )


def _figures(record: LocalisationRecord, path: LocalisedTrajectory) -> dict[str, Figure | Drawing]:
    """Return the figures of the whole drive by their keys."""
    truth = record.truth
    line = None if truth is None else truth.path
    figures: dict[str, Figure | Drawing] = {
        "path": drive_figures.path_figure(path, record.picture, line),
        "sigmas": drive_figures.sigma_figure(path),
        "drift": drive_figures.drift_figure(path),
        "counted": drive_figures.counted_figure(record.sensors),
        "rejected": drive_figures.rejected_figure(path, record.sensors),
    }
    if truth is not None:
        figures["errors"] = drive_figures.truth_figure(path, truth)
    return figures


def _section(
    index: int, sensor: SensorRecord, verdict: SensorVerdict, refined: RefinedSensor | None
) -> LocalisationSection:
    figures: dict[str, Figure | Drawing] = {}
    series, normalised = sensor.series, sensor.normalised
    if series is not None and normalised is not None:
        figures = readings.series_figures(series)
        figures["chi2"] = statistics.chi_square_figure(normalised)
    if refined is not None:
        change = tuple(np.subtract(refined.after, refined.before))
        label = "change (sigmas of before)"
        figures["refined"] = statistics.sigmas_figure(change, refined.sigma_before, label)
    anchor = f"sensor-{index}"
    return LocalisationSection(anchor, sensor, verdict, refined, pictures(figures, anchor))

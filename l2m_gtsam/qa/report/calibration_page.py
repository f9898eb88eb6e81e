"""The report on a calibration: one page that needs nothing else."""

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.progress import Progress, counter, silent
from l2m_gtsam.qa.options import QaOptions, thresholds
from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.facts import facts_of, files_of, lidar_frame
from l2m_gtsam.qa.report.figures import map as map_figures
from l2m_gtsam.qa.report.figures import readings, statistics
from l2m_gtsam.qa.report.figures.changes import changes_figure
from l2m_gtsam.qa.report.figures.comparison import drives_figure
from l2m_gtsam.qa.report.figures.vehicle import SIDE, TOP, vehicle_figure
from l2m_gtsam.qa.report.page import (
    Identity,
    Picture,
    pictures,
    render,
    roll_pitch_yaw,
    roll_pitch_yaw_sigma,
)
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.verdict.calibration import Measured, judge, measured
from l2m_gtsam.qa.verdict.places import stretch_head
from l2m_gtsam.qa.verdict.uncertainty import shares_in_words, what_helps
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import Metrics, SensorMetrics
from l2m_gtsam.records.verdict import SensorVerdict
from l2m_gtsam.storage.calibration_file import MODEL, UNCERTAINTY, calibration_content
from l2m_gtsam.storage.yaml_file import yaml_text

STAGE = "report"


@dataclass(frozen=True)
class SensorSection:
    """Everything that the page shows of one sensor.

    Attributes
    ----------
    anchor
        Name of the section in the page.
    sensor, metrics, verdict
        What it is drawn from; no metrics where it was not solved.
    pictures
        By their keys; empty where it was not solved.
    measured
        Its figures beside their limits; none where it was not solved.
    """

    anchor: str
    sensor: SensorCalibration
    metrics: SensorMetrics | None
    verdict: SensorVerdict
    pictures: dict[str, Picture]
    measured: tuple[Measured, ...]

    @property
    def roll_pitch_yaw(self) -> tuple[float, float, float] | None:
        """Of R_lidar_mag in degrees; None where that is not known."""
        R = self.sensor.R_lidar_mag
        return roll_pitch_yaw(Rotation.from_matrix(R)) if np.isfinite(R).all() else None

    @property
    def roll_pitch_yaw_sigma(self) -> FloatArray:
        """Standard deviations of these angles in degrees, shape (3,)."""
        turn = Rotation.from_matrix(self.sensor.R_lidar_mag)
        return roll_pitch_yaw_sigma(turn, self.sensor.rotation_covariance)


def calibration_page(
    result: CalibrationResult,
    metrics: Metrics,
    options: QaOptions,
    progress: Progress = silent,
    identity: Identity | None = None,
) -> str:
    """Return the report on a calibration as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.

    Parameters
    ----------
    metrics
        Its figures.
    options
        Thresholds of the verdict.
    progress
        Called with a stage and the fraction of it that is done.
    identity
        Of the file that the calibration was written to; absent where it was not.
    """
    report = counter(STAGE, progress)
    steps = len(result.sensors) + 2
    report(0, steps)
    verdict, sections = judge(result, metrics, options), []
    with mpl.rc_context(SETTINGS):
        figures: dict[str, Figure | Drawing] = {
            "vehicle-0": vehicle_figure(result, verdict, TOP),
            "vehicle-1": vehicle_figure(result, verdict, SIDE),
            "map-strength": map_figures.strength_figure(
                metrics, result.disagreements, result.sources
            ),
            "map-sigma": map_figures.sigma_figure(metrics),
        }
        if result.sources:
            path = np.array(metrics.drive.path)
            figures["changes"] = changes_figure(metrics.map, path, result.sources)
        for k, each in enumerate(result.sensors):
            report(k + 1, steps)
            anchor, found = f"sensor-{k}", metrics.get(each.sensor)
            drawn = {} if found is None else _figures(each, found)
            own = verdict[each.sensor]
            beside = () if found is None else measured(each, found, options)
            section = SensorSection(anchor, each, found, own, pictures(drawn, anchor), beside)
            sections.append(section)
        report(steps - 1, steps)
        return render(
            "report.html.j2",
            result=result,
            facts=facts_of(result),
            lidar=lidar_frame(result),
            files=files_of(result),
            metrics=metrics,
            verdict=verdict,
            found=[each for each in result.sensors if np.isfinite(each.t_lidar_mag).all()],
            pictures=pictures(figures),
            sections=sections,
            cause_of_stretch=stretch_head,
            shares=shares_in_words,
            what_helps=what_helps,
            strongest_correlation=statistics.strongest_correlation,
            thresholds=thresholds(options),
            repeatability="" if options.halves else " Not judged (qa.halves).",
            uncertainty=UNCERTAINTY[result.uncertainty],
            model=MODEL,
            options=yaml_text(result.options, ""),
            identity=identity or Identity(calibration_content(result)["id"]),
        )


def _figures(sensor: SensorCalibration, found: SensorMetrics) -> dict[str, Figure | Drawing]:
    """Return the figures of a sensor by their keys."""
    figures: dict[str, Figure | Drawing] = {
        **readings.series_figures(found.series),
        "chi2": statistics.chi_square_figure(found.normalised),
        "auto": statistics.autocorrelation_figure(found),
        "directions": readings.directions_figure(found),
        "correlations": statistics.correlation_figure(sensor),
    }
    if not found.halves.reason:
        figures["halves"] = statistics.halves_figure(found)
    if found.drives is not None and found.drives.compared:
        figures["drives"] = drives_figure(sensor, found.drives)
    return figures

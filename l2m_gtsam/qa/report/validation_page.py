"""The page of a validation: one file that needs nothing else, drawn from what was found."""

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.figures import map as map_figures
from l2m_gtsam.qa.report.figures import readings
from l2m_gtsam.qa.report.figures.changes import changes_figure
from l2m_gtsam.qa.report.figures.comparison import field_errors_figure, nis_figure
from l2m_gtsam.qa.report.figures.statistics import sigmas_figure
from l2m_gtsam.qa.report.page import Identity, Picture, pictures, render
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.verdict.changed_parts import NAMES, amount
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.validation import (
    CalibrationPart,
    ComparedSensor,
    Displaced,
    DriveValidation,
    ValidatedSensor,
    Validation,
)
from l2m_gtsam.records.verdict import SensorVerdict


@dataclass(frozen=True)
class ValidationSection:
    """What the page shows of one sensor.

    Attributes
    ----------
    anchor
        Name of the section in the page.
    verdict
        Its verdict.
    tested, compared
        On the drive, and beside the older calibration; absent where that was not done.
    detectable
        The smallest changes that the drive would have shown, in words.
    pictures
        By their keys.
    """

    anchor: str
    verdict: SensorVerdict
    tested: ValidatedSensor | None
    compared: ComparedSensor | None
    detectable: str
    pictures: dict[str, Picture]


def validation_page(found: Validation, identity: Identity) -> str:
    """Return a validation as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.

    Parameters
    ----------
    identity
        Of the file that it was written to.
    """
    with mpl.rc_context(SETTINGS):
        return render(
            "validation.html.j2",
            found=found,
            identity=identity,
            verdict=found.verdict,
            sections=[_section(k, each, found) for k, each in enumerate(found.verdict.sensors)],
            pictures={} if found.drive is None else pictures(_figures(found.drive)),
            shifts="" if found.drive is None else _detectable_shifts(found.drive),
            thresholds=found.thresholds,
        )


def _figures(drive: DriveValidation) -> dict[str, Figure | Drawing]:
    """Return the figures of all sensors together and of the place by their keys."""
    metrics = Metrics((), drive.drive, drive.picture)
    figures: dict[str, Figure | Drawing] = {
        "map-strength": map_figures.strength_figure(metrics, ()),
        "map-sigma": map_figures.sigma_figure(metrics),
    }
    if drive.sources:
        path = np.array(drive.drive.path)
        figures["changes"] = changes_figure(drive.picture, path, drive.sources)
    if drive.sensors:
        figures["field-errors"] = field_errors_figure(drive.sensors)
        figures["nis"] = nis_figure(drive.sensors)
    return figures


def _section(index: int, verdict: SensorVerdict, found: Validation) -> ValidationSection:
    drive = () if found.drive is None else found.drive.sensors
    both = () if found.comparison is None else found.comparison.sensors
    tested = next((each for each in drive if each.sensor == verdict.sensor), None)
    compared = next((each for each in both if each.sensor == verdict.sensor), None)
    figures: dict[str, Figure | Drawing] = {}
    if tested is not None:
        figures = readings.series_figures(tested.series)
    if compared is not None:
        label = "new less old (sigmas)"
        figures["change"] = sigmas_figure(compared.difference, compared.sigma, label)
    anchor, detectable = f"sensor-{index}", "" if tested is None else _detectable(tested)
    shown = pictures(figures, anchor)
    return ValidationSection(anchor, verdict, tested, compared, detectable, shown)


def _detectable_shifts(drive: DriveValidation) -> str:
    """Return which shifts of all sensors together the drive would have shown, as a sentence."""
    what = {Displaced.LIDAR: "all sensors together", Displaced.FRAME: "the frame of the poses"}
    shown = " and ".join(
        f"a shift of {what[each.of]} by {amount(CalibrationPart.PLACE, each.size)}"
        for each in drive.detectable_shifts
        if np.isfinite(each.size)
    )
    return f"With nothing else changed, this drive would show {shown} or more." if shown else ""


def _detectable(sensor: ValidatedSensor) -> str:
    """Return what the drive would have shown, as a sentence."""
    shown = [
        f"{NAMES[each.part]} by {amount(each.part, each.size)}"
        for each in sensor.detectable
        if np.isfinite(each.size)
    ]
    if not shown:
        return "This drive would show no change of a single part."
    return f"Each by itself, this drive would show a change of {', '.join(shown)} or more."

"""The page of a validation: one file that needs nothing else, drawn from what was found."""

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np

from l2m_gtsam.qa.report.figures import map as map_figures
from l2m_gtsam.qa.report.figures import readings
from l2m_gtsam.qa.report.figures.comparison import field_errors_figure, nis_figure
from l2m_gtsam.qa.report.figures.statistics import sigmas_figure
from l2m_gtsam.qa.report.page import (
    Picture,
    picture,
    render,
    residual_map_picture,
)
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.verdict.validation import NAMES, amount
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.records.validation import (
    ComparedSensor,
    DriveValidation,
    ValidatedSensor,
    Validation,
)
from l2m_gtsam.records.verdict import SensorVerdict
from l2m_gtsam.solve.rank import PARAMETERS


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
        In the order of the page.
    """

    anchor: str
    verdict: SensorVerdict
    tested: ValidatedSensor | None
    compared: ComparedSensor | None
    detectable: str
    pictures: tuple[Picture, ...]


def validation_page(found: Validation) -> str:
    """Return a validation as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.
    """
    with mpl.rc_context(SETTINGS):
        sections = [_section(k, each, found) for k, each in enumerate(found.verdict.sensors)]
        pictures = () if found.drive is None else _overall(found.drive)
    return render(
        "validation.html.j2",
        found=found,
        verdict=found.verdict,
        sections=sections,
        pictures=pictures,
        thresholds=found.thresholds,
        parameters=PARAMETERS,
    )


def _section(index: int, verdict: SensorVerdict, found: Validation) -> ValidationSection:
    anchor = f"sensor-{index}"
    drive = () if found.drive is None else found.drive.sensors
    both = () if found.comparison is None else found.comparison.sensors
    tested = next((each for each in drive if each.sensor == verdict.sensor), None)
    compared = next((each for each in both if each.sensor == verdict.sensor), None)
    pictures = [] if tested is None else _of_drive(anchor, tested)
    if compared is not None:
        pictures.append(_of_comparison(anchor, compared))
    detectable = "" if tested is None else _detectable(tested)
    return ValidationSection(anchor, verdict, tested, compared, detectable, tuple(pictures))


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


def _overall(drive: DriveValidation) -> tuple[Picture, ...]:
    """Return pictures of all sensors together and of the place."""
    where = f"A drive of {drive.drive.length:.0f} m in {drive.drive.seconds:.0f} s"
    metrics = Metrics((), drive.drive, drive.picture)
    on_map = (
        picture(
            "Field and drive",
            map_figures.strength_figure(metrics, ()),
            "map-strength",
            f"{where} over the map's field strength.",
            "What the readings are compared with: the field of the map along this drive.",
        ),
        picture(
            "How well the map knows it",
            map_figures.sigma_figure(metrics),
            "map-sigma",
            f"{where} over the map's standard deviation.",
            "Where the map is not well known, a drive is a weak test of a calibration.",
        ),
    )
    return (*_of_all(drive.sensors), *on_map) if drive.sensors else on_map


def _of_all(sensors: Sequence[ValidatedSensor]) -> tuple[Picture, ...]:
    errors = ", ".join(
        f"{each.sensor} {each.before.mean:.2g} µT before and {each.after.mean:.2g} µT after"
        for each in sensors
    )
    ratios = ", ".join(f"{each.sensor} {each.nis.ratio:.2f}" for each in sensors)
    good = sum(each.nis.consistent for each in sensors)
    return (
        picture(
            "Before and after",
            field_errors_figure(sensors),
            "field-errors",
            f"Mean distance of the readings to the map's field: {errors}.",
            "How far readings are from the map's field, as read and with the calibration undone; "
            "a bar is one standard deviation of the distance.",
        ),
        picture(
            "As exact as stated?",
            nis_figure(sensors),
            "nis",
            f"Normalised innovation squared per degree of freedom: {ratios}.",
            f"{good} of {len(sensors)} within the band where 95 % of all lie if noise, map and "
            "calibration are as exact as they state. To the right: errors are larger than stated.",
        ),
    )


def _of_drive(anchor: str, sensor: ValidatedSensor) -> list[Picture]:
    name, before, after = sensor.sensor, sensor.before.squared**0.5, sensor.after.squared**0.5
    wrong = sum(sensor.series.rejected)
    return [
        picture(
            "Before, after, map",
            readings.curves_figure(sensor.series),
            f"{anchor}-curves",
            f"Readings of {name} along the lidar's axes before and after the calibration beside "
            f"the map's: {before:.1f} and {after:.2f} µT rms away from it.",
            f"The dashed line should lie on the broad one: {before:.1f} µT away before, "
            f"{after:.2f} µT after (rms of the length).",
        ),
        picture(
            "Residuals over time",
            readings.residuals_figure(sensor.series),
            f"{anchor}-residuals",
            f"Residuals of {name} over time; {wrong} drawn readings are rejected.",
            "Should look like noise around zero. A level that is off is a changed H; crosses do "
            "not count.",
        ),
        residual_map_picture(anchor, name, sensor.series),
    ]


def _of_comparison(anchor: str, sensor: ComparedSensor) -> Picture:
    whole = sensor.test("all")
    return picture(
        "New less old calibration",
        sigmas_figure(sensor.difference, sensor.sigma, "new less old (sigmas)"),
        f"{anchor}-change",
        f"Differences of the parameters of {sensor.sensor} in sigmas: chi-square "
        f"{whole.chi_square:.1f} of {whole.freedom} degrees of freedom.",
        "Bars beyond the band differ by more than both uncertainties allow. Correlated parameters "
        "move together: the tests beside show which part has changed.",
    )

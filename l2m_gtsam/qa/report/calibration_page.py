"""The report on a calibration: one page that needs nothing else."""

import hashlib
import json
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np

from l2m_gtsam.progress import Progress, counter, silent
from l2m_gtsam.qa.options import QaOptions, thresholds
from l2m_gtsam.qa.report import words
from l2m_gtsam.qa.report.figures import map as map_figures
from l2m_gtsam.qa.report.figures import readings, statistics
from l2m_gtsam.qa.report.figures.comparison import drive_names, drives_figure
from l2m_gtsam.qa.report.figures.vehicle import SIDE, TOP, vehicle_figure
from l2m_gtsam.qa.report.page import (
    Picture,
    normalised_picture,
    picture,
    render,
    residual_map_picture,
    vector,
)
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.qa.verdict.calibration import judge
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import Metrics, Repeatability, SensorMetrics
from l2m_gtsam.records.verdict import SensorVerdict, Verdict
from l2m_gtsam.solve.rank import PARAMETERS
from l2m_gtsam.storage.calibration_file import MODEL, UNCERTAINTY

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
        In the order of the page.
    rotation, distortion, rests_on
        In words; empty where it was not solved.
    """

    anchor: str
    sensor: SensorCalibration
    metrics: SensorMetrics | None
    verdict: SensorVerdict
    pictures: tuple[Picture, ...] = ()
    rotation: str = ""
    distortion: tuple[str, ...] = ()
    rests_on: tuple[str, ...] = ()


def calibration_page(
    result: CalibrationResult,
    metrics: Metrics,
    options: QaOptions,
    progress: Progress = silent,
) -> str:
    """Return the report on a calibration as HTML.

    Text from bags is escaped; nothing is loaded from anywhere.

    Parameters
    ----------
    result
        The calibration.
    metrics
        Its figures.
    options
        Thresholds of the verdict.
    progress
        Called with a stage and the fraction of it that is done.
    """
    tell = counter(STAGE, progress)
    steps = len(result.sensors) + 2
    tell(0, steps)
    verdict, sections = judge(result, metrics, options), []
    with mpl.rc_context(SETTINGS):
        vehicle, place = _overall_pictures(result, metrics, verdict)
        for k, each in enumerate(result.sensors):
            tell(k + 1, steps)
            sections.append(_sensor_section(k, each, result, metrics, verdict[each.sensor]))
    tell(steps - 1, steps)
    return render(
        "report.html.j2",
        result=result,
        metrics=metrics,
        verdict=verdict,
        vehicle=vehicle,
        place=place,
        sections=sections,
        position=words.position,
        thresholds=thresholds(options),
        parameters=PARAMETERS,
        uncertainty=UNCERTAINTY[result.uncertainty],
        model=MODEL,
        options=json.dumps(result.options, indent=2, ensure_ascii=False),
        fingerprint=_fingerprint(result),
    )


def _fingerprint(result: CalibrationResult) -> str:
    """Return ten digits of a digest of a calibration's numbers."""
    digest = hashlib.sha256()
    for sensor in result.sensors:
        digest.update(sensor.sensor.encode(errors="surrogatepass"))
        for part in (sensor.t_lidar_mag, sensor.distortion.vector(), sensor.covariance):
            digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:10]


def _overall_pictures(
    result: CalibrationResult, metrics: Metrics, verdict: Verdict
) -> tuple[tuple[Picture, ...], tuple[Picture, ...]]:
    """Return pictures of the vehicle, and those of the place."""
    names = ", ".join(
        f"{each.sensor} at {vector(each.t_lidar_mag, 3)} m"
        for each in result.sensors
        if np.isfinite(each.t_lidar_mag).all()
    )
    vehicle = tuple(
        picture(
            f"Sensors {view.name}",
            vehicle_figure(result, verdict, view),
            f"vehicle-{index}",
            f"The vehicle {view.name}: {names}, the lidar at the origin.",
            "Circle passes, triangle warns, cross fails; the square is the lidar. A dotted line "
            "is a direction in which the place is not known.",
        )
        for index, view in enumerate((TOP, SIDE))
    )
    drive = metrics.drive
    count = len(metrics.bags or ())
    what = f"{count} drives" if count else "A drive"
    where = f"{what} of {drive.length:.0f} m in {drive.seconds:.0f} s"
    on_map = (
        picture(
            "Field and drive",
            map_figures.strength_figure(metrics, result.disagreements),
            "map-strength",
            f"{where} over the map's field strength; {len(result.disagreements)} stretches where "
            "readings and map disagree.",
            "Positions follow from changes of the field; a drive through uniform colour determines "
            "little. Thick marks: where readings and map disagree.",
        ),
        picture(
            "How well the map knows it",
            map_figures.sigma_figure(metrics),
            "map-sigma",
            f"{where} over the map's standard deviation.",
            "The drive should stay where the map is well known.",
        ),
    )
    return vehicle, on_map


def _sensor_section(
    index: int,
    sensor: SensorCalibration,
    result: CalibrationResult,
    metrics: Metrics,
    verdict: SensorVerdict,
) -> SensorSection:
    """Return what the page shows of a sensor."""
    anchor, found = f"sensor-{index}", metrics.get(sensor.sensor)
    if found is None:
        return SensorSection(anchor, sensor, None, verdict)
    return SensorSection(
        anchor=anchor,
        sensor=sensor,
        metrics=found,
        verdict=verdict,
        pictures=_pictures(anchor, sensor, found),
        rotation=words.rotation(sensor, found),
        distortion=tuple(words.distortion(sensor, found)),
        rests_on=tuple(words.rests_on(found, result)),
    )


def _pictures(anchor: str, sensor: SensorCalibration, found: SensorMetrics) -> tuple[Picture, ...]:
    name = sensor.sensor
    pictures = [
        _curves(anchor, name, found),
        _residuals(anchor, name, found),
        residual_map_picture(anchor, name, found.series),
        normalised_picture(anchor, name, found.normalised, "the noise is as assumed"),
        _autocorrelation(anchor, name, found),
        _directions(anchor, name, found),
        _correlations(anchor, sensor),
    ]
    if not found.halves.reason:
        pictures.insert(3, _halves(anchor, name, found))
    if found.drives is not None and found.drives.compared:
        pictures.insert(3, _drives(anchor, sensor, found.drives))
    return tuple(pictures)


def _curves(anchor: str, name: str, found: SensorMetrics) -> Picture:
    before, after = found.curves.before**0.5, found.curves.after**0.5
    return picture(
        "Before, after, map",
        readings.curves_figure(found.series),
        f"{anchor}-curves",
        f"Readings of {name} along the lidar's axes before and after the calibration beside the "
        f"map's: {before:.1f} and {after:.2f} µT rms away from it.",
        f"After the calibration the dashed line should lie on the broad one: {before:.1f} µT away "
        f"before, {after:.2f} µT after (rms of the length).",
    )


def _residuals(anchor: str, name: str, found: SensorMetrics) -> Picture:
    rms = ", ".join(f"{each:.2f}" for each in found.fit.rms)
    wrong = sum(found.series.rejected)
    return picture(
        "Residuals over time",
        readings.residuals_figure(found.series),
        f"{anchor}-residuals",
        f"Residuals of {name} over time: rms {rms} µT along x, y, z; {wrong} drawn readings are "
        "rejected.",
        f"Should look like noise around zero: rms {rms} µT. Crosses do not count; those beyond the "
        "picture are drawn at its edge.",
    )


def _halves(anchor: str, name: str, found: SensorMetrics) -> Picture:
    halves = found.halves
    return picture(
        "Repeatability",
        statistics.halves_figure(found),
        f"{anchor}-halves",
        f"{name} calibrated on each half of the drive: {halves.distance:.1f} sigmas apart.",
        f"Each half of the drive by itself: {halves.distance:.1f} times as far apart as expected "
        f"(1 is consistent), by {1e3 * np.linalg.norm(halves.difference[:3]):.0f} mm and "
        f"{halves.turned_deg:.1f}°.",
    )


def _drives(anchor: str, sensor: SensorCalibration, found: Repeatability) -> Picture:
    names = drive_names([each.bag for each in found.drives])
    return picture(
        "Repeatability between drives",
        drives_figure(sensor, found),
        f"{anchor}-drives",
        f"{sensor.sensor} calibrated on each drive by itself, less all together, with standard "
        f"deviations: {words.drives(found)}.",
        f"Each drive by itself less all together (grey: its sigma), ± 1 sigma; a cross is a drive "
        f"that is not enough. {words.drives(found)}. Drives: {names}.",
    )


def _autocorrelation(anchor: str, name: str, found: SensorMetrics) -> Picture:
    next_ = found.autocorrelation.next
    return picture(
        "Autocorrelation",
        statistics.autocorrelation_figure(found),
        f"{anchor}-auto",
        f"Autocorrelation of the residuals of {name}: {next_:.2f} between neighbours.",
        f"Lag-1 correlation {next_:.2f} (about {found.autocorrelation.step_s:.2g} s): what lies "
        "above the band is no noise of the sensor but errors of map or poses.",
    )


def _directions(anchor: str, name: str, found: SensorMetrics) -> Picture:
    spread = ", ".join(f"{each:.1f}" for each in found.directions.spread)
    return picture(
        "Directions of the field",
        readings.directions_figure(found),
        f"{anchor}-directions",
        f"Directions from which the field came to {name}: {found.directions.covered:.0%} of space.",
        f"{found.directions.covered:.0%} of all directions, {found.directions.tilt_deg:.0f}° of "
        f"elevation; spread {spread} µT along its principal axes. A ring is a drive on level "
        "ground.",
    )


def _correlations(anchor: str, sensor: SensorCalibration) -> Picture:
    strongest = words.strongest(sensor)
    return picture(
        "Correlations",
        statistics.correlation_figure(sensor),
        f"{anchor}-correlations",
        f"Correlations between the parameters of {sensor.sensor}; the strongest: {strongest}.",
        f"The strongest: {strongest}. + and − mark those above 0.5; blank rows are not determined.",
    )

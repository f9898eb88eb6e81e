"""The report: one page that needs nothing else."""

import hashlib
import json
from functools import cache

import matplotlib as mpl
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from l2m_gtsam.progress import Progress, counter
from l2m_gtsam.qa.judge import judge
from l2m_gtsam.qa.options import Limit, QaOptions
from l2m_gtsam.qa.report import words
from l2m_gtsam.qa.report.sections import overall_pictures, sensor_section
from l2m_gtsam.qa.report.svg import SETTINGS
from l2m_gtsam.records.calibration import CalibrationResult
from l2m_gtsam.records.metrics import Metrics
from l2m_gtsam.solve.rank import PARAMETERS
from l2m_gtsam.storage.calibration_file import MODEL, UNCERTAINTY

STAGE = "report"


def report_page(
    result: CalibrationResult,
    metrics: Metrics,
    options: QaOptions,
    progress: Progress | None = None,
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
    tell = counter(STAGE, progress or (lambda stage, fraction: None))
    steps = len(result.sensors) + 2
    tell(0, steps)
    verdict, sections = judge(result, metrics, options), []
    with mpl.rc_context(SETTINGS):
        vehicle, place = overall_pictures(result, metrics, verdict)
        for k, each in enumerate(result.sensors):
            tell(k + 1, steps)
            sections.append(sensor_section(k, each, result, metrics, verdict[each.sensor]))
    tell(steps - 1, steps)
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            result=result,
            metrics=metrics,
            verdict=verdict,
            vehicle=vehicle,
            place=place,
            sections=sections,
            limits=limits(options),
            parameters=PARAMETERS,
            uncertainty=UNCERTAINTY[result.uncertainty],
            model=MODEL,
            options=json.dumps(result.options, indent=2, ensure_ascii=False),
            fingerprint=fingerprint(result),
            style=style(),
        )
    )


def limits(options: QaOptions) -> list[tuple[str, float, float, str]]:
    """Return the thresholds of the verdict: name, warning, failure and what it is."""
    fields = type(options).model_fields
    return [
        (name, value.warn, value.fail, fields[name].description or "")
        for name, value in options
        if isinstance(value, Limit)
    ]


def fingerprint(result: CalibrationResult) -> str:
    """Return what tells this calibration from any other: of its numbers, in ten digits."""
    digest = hashlib.sha256()
    for sensor in result.sensors:
        digest.update(sensor.sensor.encode(errors="surrogatepass"))
        for part in (sensor.t_lidar_mag, sensor.distortion.vector(), sensor.covariance):
            digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:10]


def style() -> Markup:
    """Return the page's style."""
    found = environment()
    text, _, _ = found.loader.get_source(found, "style.css")  # type: ignore[union-attr]  # it has one
    return Markup(text)  # noqa: S704 - our own file


@cache
def environment() -> Environment:
    """Return what renders the templates."""
    made = Environment(
        loader=PackageLoader("l2m_gtsam.qa.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"number": number, "position": words.position, "vector": words.vector}
    return made


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash where it is none or infinite."""
    return f"{value:.{digits}g}" if np.isfinite(value) else "–"

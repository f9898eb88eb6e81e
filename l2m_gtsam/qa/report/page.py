"""What the pages have in common: templates, numbers, pictures. A page needs no other file."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.figures.map import residual_figure
from l2m_gtsam.qa.report.figures.statistics import chi_square_figure
from l2m_gtsam.qa.report.svg import as_svg
from l2m_gtsam.records.metrics import Normalised, Series


@dataclass(frozen=True)
class Picture:
    """A figure of a page: its title, the drawing, and what to look for."""

    title: str
    svg: Markup
    caption: str


def picture(title: str, figure: Figure | Drawing, name: str, alt: str, caption: str) -> Picture:
    """Return a figure of the page; see ``Picture`` and ``as_svg``."""
    return Picture(title, as_svg(figure, name, alt), caption)


def residual_map_picture(anchor: str, sensor: str, series: Series) -> Picture:
    """Return the residuals of a sensor over the map."""
    return picture(
        "Residuals over the map",
        residual_figure(series),
        f"{anchor}-place",
        f"Length of the residuals of {sensor} where they were read.",
        "Bright spots that keep together are places where map and readings disagree.",
    )


def normalised_picture(anchor: str, sensor: str, found: Normalised, as_stated: str) -> Picture:
    """Return the normalised residuals of a sensor, and what bars on the dashed line mean."""
    std = ", ".join(f"{each:.2f}" for each in found.std)
    return picture(
        "Normalised residuals",
        chi_square_figure(found),
        f"{anchor}-chi2",
        f"Squared normalised residuals of {sensor} beside chi-square: standard deviations {std} "
        f"along x, y, z, {found.beyond_95:.1%} beyond the 95 % quantile.",
        f"Bars on the dashed line: {as_stated}. Standard deviations {std} (1 is consistent).",
    )


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash where it is none or infinite."""
    return f"{value:.{digits}g}" if np.isfinite(value) else "–"


def with_sigma(value: float, sigma: float, digits: int) -> str:
    """Return a value with its standard deviation; "not determined" where that is infinite."""
    if not np.isfinite(sigma) or not np.isfinite(value):
        return "not determined"
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def vector(values: FloatArray, digits: int) -> str:
    """Return a vector in brackets."""
    # adding zero takes the sign from a zero
    rounded = np.round(np.asarray(values, dtype=float), digits) + 0.0
    return "(" + ", ".join(f"{value:.{digits}f}" for value in rounded) + ")"


def render(template: str, **values: Any) -> str:
    """Return a page as HTML; text is escaped, nothing is loaded from anywhere."""
    given = {"style": own_file("style.css"), **values}
    return _environment().get_template(template).render(**given)


def own_file(name: str) -> Markup:
    """Return a file beside the templates as it is."""
    environment = _environment()
    text, _, _ = environment.loader.get_source(environment, name)  # type: ignore[union-attr]  # it has one
    return Markup(text)  # noqa: S704 - our own file


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("l2m_gtsam.qa.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "vector": vector, "with_sigma": with_sigma}
    return environment

"""What the pages have in common: templates, numbers, pictures. A page needs no other file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.svg import as_svg
from l2m_gtsam.records.metrics import Row
from l2m_gtsam.text.shown import shown_lines


@dataclass(frozen=True)
class Picture:
    """A figure of a page, and its name, which is unique in the page."""

    name: str
    figure: Figure | Drawing

    def svg(self, alt: str) -> Markup:
        """Return it as an element of the page; ``alt`` is what it shows."""
        return as_svg(self.figure, self.name, alt)


def pictures(figures: Mapping[str, Figure | Drawing], anchor: str = "") -> dict[str, Picture]:
    """Return figures of a page, named by their keys after the anchor of their section."""
    start = f"{anchor}-" if anchor else ""
    return {key: Picture(f"{start}{key}", figure) for key, figure in figures.items()}


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits; a dash where it is none or infinite."""
    return f"{value:.{digits}g}" if np.isfinite(value) else "–"


def fixed(values: float | Row, digits: int) -> str:
    """Return one number or several with so many digits behind the point."""
    each = values if isinstance(values, tuple) else (values,)
    return ", ".join(f"{value:.{digits}f}" for value in each)


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


def code(text: str) -> Markup:
    """Return a sentence in which what stands in backticks is code; all of it is text."""
    text = shown_lines(text)
    parts = str(escape(text)).split("`")
    if len(parts) % 2 == 0:  # a name has one of its own
        return escape(text)
    marked = (f"<code>{part}</code>" if k % 2 else part for k, part in enumerate(parts))
    return Markup("".join(marked))  # noqa: S704 - escaped above


def roll_pitch_yaw(turn: Rotation) -> tuple[float, float, float]:
    """Return the angles of a rotation in degrees, as ROS names them (REP 103)."""
    yaw, pitch, roll = turn.as_euler("ZYX", degrees=True)  # intrinsic z, y, x
    return roll, pitch, yaw


def render(template: str, **values: Any) -> str:
    """Return a page as HTML; text is escaped, nothing is loaded from anywhere.

    Figures are drawn here: matplotlib's need ``SETTINGS``.
    """
    given = {"style": own_file("style.css"), **values}
    return _environment().get_template(template).render(**given)


def own_file(name: str) -> Markup:
    """Return a file beside the templates as it is."""
    environment = _environment()
    text, _, _ = environment.loader.get_source(environment, name)  # type: ignore[union-attr]  # it has one
    return Markup(text)  # noqa: S704 - our own file


def _visible(value: Any) -> Any:
    """Return what a template writes, text of others without control characters."""
    is_text = isinstance(value, str) and not isinstance(value, Markup)
    return shown_lines(value) if is_text else value


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("l2m_gtsam.qa.report"),
        autoescape=True,
        finalize=_visible,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["finite"] = math.isfinite
    environment.filters |= {
        "code": code,
        "number": number,
        "fixed": fixed,
        "vector": vector,
        "with_sigma": with_sigma,
    }
    return environment

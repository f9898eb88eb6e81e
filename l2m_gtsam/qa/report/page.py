"""What the pages have in common: templates, numbers, pictures. A page needs no other file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from l2m_gtsam.data import FloatArray, SourceFile
from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.svg import as_svg
from l2m_gtsam.qa.verdict.places import best_of, cause_in_short, place_of
from l2m_gtsam.records.record import Row
from l2m_gtsam.solve.rank import PARAMETERS
from l2m_gtsam.storage.report_id import SHOWN
from l2m_gtsam.text import (
    by_sigma,
    limit,
    shown_lines,
    sigma_alone,
    significant,
    vector_by_sigma,
    vector_of_sigmas,
    with_sigma,
)

TURN = 1e-5  # rad, of central differences


@dataclass(frozen=True)
class Picture:
    """A figure of a page, and its name, which is unique in the page."""

    name: str
    figure: Figure | Drawing

    def svg(self, alt: str) -> Markup:
        """Return it as an element of the page; ``alt`` is what it shows."""
        return as_svg(self.figure, self.name, alt)


@dataclass(frozen=True)
class Identity:
    """What a page is of.

    Attributes
    ----------
    id
        SHA-256 of all that the result says, 64 hexadecimal digits.
    file
        The file that carries it; absent where nothing was written.
    """

    id: str
    file: SourceFile | None = None

    @property
    def short(self) -> str:
        """As many digits of the id as are shown where there is no room for all."""
        return self.id[:SHOWN]

    @property
    def name(self) -> str:
        """Name of the file, without where it is."""
        return "" if self.file is None else Path(self.file.path).name


def pictures(figures: Mapping[str, Figure | Drawing], anchor: str = "") -> dict[str, Picture]:
    """Return figures of a page, named by their keys after the anchor of their section."""
    start = f"{anchor}-" if anchor else ""
    return {key: Picture(f"{start}{key}", figure) for key, figure in figures.items()}


def fixed(values: float | Row, digits: int) -> str:
    """Return one number or several with so many digits behind the point."""
    each = values if isinstance(values, tuple) else (values,)
    return ", ".join(f"{value:.{digits}f}" for value in each)


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


def roll_pitch_yaw_sigma(turn: Rotation, covariance: FloatArray) -> FloatArray:
    """Return standard deviations of these angles in degrees, shape (3,).

    Parameters
    ----------
    turn
        ``R_lidar_mag``.
    covariance
        Of its error in the sensor frame in rad^2, shape (3, 3); infinite where it is open.
    """
    if not np.isfinite(covariance).all():
        return np.full(3, np.inf)
    moved = [
        roll_pitch_yaw(turn * Rotation.from_rotvec(TURN * axis))
        for axis in (*np.eye(3), *-np.eye(3))
    ]
    ahead, behind = np.deg2rad(moved[:3]), np.deg2rad(moved[3:])
    # an angle may pass from pi to -pi in between
    J = ((ahead - behind + np.pi) % (2 * np.pi) - np.pi).T / (2 * TURN)
    return np.asarray(np.rad2deg(np.sqrt(np.diag(J @ covariance @ J.T))))


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
    environment.globals |= {
        "parameters": PARAMETERS,
        "length": np.linalg.norm,
        "what_else": best_of,
        "cause": cause_in_short,
        "place": place_of,
    }
    environment.filters |= {
        "code": code,
        "number": significant,
        "limit": limit,
        "fixed": fixed,
        "vector": vector,
        "by_sigma": by_sigma,
        "sigma": sigma_alone,
        "sigmas": vector_of_sigmas,
        "with_sigma": with_sigma,
        "vector_by_sigma": vector_by_sigma,
    }
    return environment

"""Matplotlib figures: new ones, their parts, and as SVG in the colours and fonts of a page."""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import singledispatch
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from l2m_gtsam.data import FloatArray
from l2m_gtsam.storage.files import atomic_path
from l2m_gtsam.text import shown, shown_lines

# Placeholders for variables of the page's style, so that a figure follows light and dark.
INK, MUTED, GRID, PAPER = "#010203", "#040506", "#070809", "#0a0b0c"
X, Y, Z = "#0b0a01", "#0b0a02", "#0b0a03"
GOOD, FAIR, BAD = "#0b0a04", "#0b0a05", "#0b0a06"
VARIABLES = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    PAPER: "--card",
    X: "--x",
    Y: "--y",
    Z: "--z",
    GOOD: "--pass",
    FAIR: "--warn",
    BAD: "--fail",
}
AXES = (X, Y, Z)
DASHES = ("-", "--", "-.")  # lines of x, y, z differ without their colours, too

HOVER = (
    "hover-"  # before words, in hexadecimal, that name a part of a figure: they become its title
)

UNSAID = ("Date", "Creator", "Format", "Type")  # facts that would differ from run to run

SMALL = 9.3  # points; a figure is drawn at about its own size on a phone

SETTINGS: Any = {
    "svg.fonttype": "none",  # text stays text: sharp, small, read aloud
    "svg.hashsalt": "l2m",
    "text.parse_math": False,  # names from bags are text, whatever they hold
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.labelsize": 10,
    "legend.fontsize": SMALL,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": GRID,
    "axes.grid": True,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.frameon": False,
    "lines.linewidth": 1.1,
    "path.simplify": False,  # it would take dots for nothing
}
LONGEST = 18  # letters of a name
WIDTH = 4.7  # inches of every figure: its text is then as large on a phone as on a desk


def new_figure(height: float) -> Figure:
    """Return an empty figure of so many inches."""
    return Figure(figsize=(WIDTH, height), layout="constrained", dpi=110)


def plain_figure(height: float) -> Figure:
    """Return an empty figure with margins for usual labels: laying out takes as long as drawing."""
    figure = Figure(figsize=(WIDTH, height), dpi=110)
    figure.subplots_adjust(
        left=0.17, right=0.975, bottom=0.5 / height, top=1 - 0.3 / height, hspace=0.12
    )
    return figure


@singledispatch
def as_svg(figure: Any, name: str, alt: str) -> Markup:
    """Return a figure as an element of a page.

    Parameters
    ----------
    figure
        A ``Drawing``, or one of matplotlib that was drawn under ``SETTINGS``.
    name
        Unique in the page; put before all names inside, so that figures do not share any.
    alt
        What it shows, for those who do not see it.
    """
    raise TypeError(f"{name}: {type(figure).__name__} is no figure")


@as_svg.register
def _(figure: Figure, name: str, alt: str) -> Markup:
    stream = StringIO()
    lay_out(figure)
    with _names_shown(figure):
        figure.savefig(stream, format="svg", metadata=dict.fromkeys(UNSAID))
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(rf'<g id="{HOVER}([0-9a-f]*)">', _title, text)
    text = _renamed(text, name)
    text = re.sub(r' d="([^"]*)"', lambda found: f' d="{_short(found.group(1))}"', text)
    for colour, variable in VARIABLES.items():
        text = text.replace(colour, f"var({variable})")
    head, rest = text.split(">", 1)
    box = re.search(r'viewBox="[^"]*"', head)
    shape = box.group() if box else ""
    label = f'role="img" aria-label="{escape(shown_lines(alt))}"'
    # what is inside comes from matplotlib, which escapes its text
    return Markup(f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" {shape} {label}>{rest}')  # noqa: S704


def dots(axes: Axes, x: FloatArray, y: FloatArray, size: float, **style: Any) -> None:
    """Draw points as one path of round caps: a marker each would take five times the space."""
    across = np.column_stack([x, x, np.full(len(x), np.nan)]).ravel()
    along = np.column_stack([y, y, np.full(len(y), np.nan)]).ravel()
    axes.plot(across, along, "-", linewidth=size, solid_capstyle="round", **style)


def ellipse(centre: FloatArray, covariance: FloatArray, sigmas: float) -> Ellipse:
    """Return an error ellipse.

    Parameters
    ----------
    centre
        Shape (2,).
    covariance
        Shape (2, 2).
    sigmas
        Half axes in standard deviations along them.
    """
    variances, directions = np.linalg.eigh(covariance)
    width, height = 2 * sigmas * np.sqrt(np.maximum(variances, 0.0))
    angle = float(np.rad2deg(np.arctan2(directions[1, 0], directions[0, 0])))
    return Ellipse((float(centre[0]), float(centre[1])), width, height, angle=angle)


def plain_decades(axis: Axis, wide: bool) -> None:
    """Label a logarithmic axis with plain numbers: mathematics is text in these figures."""
    axis.set_major_locator(LogLocator(subs=[1.0] if wide else [1.0, 2.0, 5.0]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    lay_out(figure)
    with atomic_path(path) as temporary, _names_shown(figure):
        figure.savefig(temporary, format="png")


@contextmanager
def _names_shown(figure: Figure) -> Iterator[None]:
    """Have names in a figure as text: control characters, mathematics, letters of no font."""
    ticks = {
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for label in (*axis.get_ticklabels(), *axis.get_ticklabels(minor=True))
    }
    for words in figure.findobj(Text):
        if isinstance(words, Text) and words not in ticks:
            words.set_text(shown_lines(words.get_text()))
            words.set_parse_math(False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=r"Glyph \d+ .* missing from font")
        yield


def lay_out(figure: Figure) -> None:
    """Place the axes of a figure for good.

    Saved with an engine that would place them, it is drawn once more for nothing.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def short_name(name: str) -> str:
    """Return a name that fits into a figure."""
    name = shown(name, None)
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"


def hover_name(words: str) -> str:
    """Return the name of a part of matplotlib's whose title these words shall be."""
    return HOVER + words.encode(errors="replace").hex()


def _title(found: re.Match[str]) -> str:
    words = bytes.fromhex(found[1]).decode()
    return f'<g class="hover"><title>{escape(shown_lines(words))}</title>'


def _short(path: str) -> str:
    """Return a path with coordinates to a tenth of a point, and blanks for ends of lines."""
    return re.sub(r"(\.\d)\d+", r"\1", path).replace("\n", " ").strip()


def _renamed(text: str, name: str) -> str:
    """Return SVG with a prefix for every name, where it is given and where it is used."""
    text = re.sub(r' id="([^"]+)"', rf' id="{name}-\1"', text)
    text = re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", text)
    return re.sub(r'href="#([^"]+)"', rf'href="#{name}-\1"', text)

"""Figures of a report that are written as SVG at once, without matplotlib's axes.

A report has a hundred small figures of few kinds. Of each of them, axes and ticks alone take
matplotlib longer than all else of the report.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from markupsafe import Markup, escape
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.ticker import MaxNLocator

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.report.svg import GRID, INK, MUTED, SMALL, VARIABLES, WIDTH, as_svg
from l2m_gtsam.text import shown_lines

STEPS = [1, 2, 2.5, 5, 10]
TICK = 3.5  # points
LABEL = 10.0  # points, of letters
POINTS = 72  # of an inch
PAGE = WIDTH * POINTS  # points across
LEFT, RIGHT, TOP, BOTTOM = 57.0, 8.0, 21.6, 36.0  # margins in points, for usual labels
GAP = 9.0  # points between axes above each other
SAMPLE = 20.0  # points of a line in a legend
LETTER = 0.53  # of their size: how wide letters are on average
COLOURS = 48  # that a picture has: as many paths, however many points
Limits = tuple[float, float]


@dataclass(frozen=True)
class Stroke:
    """How a line is drawn: colour, width in points, dashes in points, opacity, round ends."""

    colour: str
    width: float = 1.1
    dashes: tuple[float, ...] = ()
    alpha: float = 1.0
    round: bool = False

    @property
    def style(self) -> str:
        """Return it as SVG has it."""
        dashes = f";stroke-dasharray:{','.join(map(str, self.dashes))}" if self.dashes else ""
        ends = ";stroke-linecap:round" if self.round else ""
        return (
            f"fill:none;stroke:{paint(self.colour)};stroke-width:{self.width}"
            f"{dashes}{ends}{opacity(self.alpha)}"
        )


@dataclass(frozen=True)
class Rectangle:
    """A rectangle of the page in points: its left upper corner and its size."""

    left: float
    top: float
    width: float
    height: float

    @property
    def right(self) -> float:
        """Right edge."""
        return self.left + self.width

    @property
    def bottom(self) -> float:
        """Lower edge."""
        return self.top + self.height


@dataclass(frozen=True)
class Panel:
    """Axes with linear scales.

    Attributes
    ----------
    box
        Where they are in the figure.
    x, y
        Values at the left and right, and at the lower and upper edge.
    parts
        Elements that were drawn, in order.
    """

    box: Rectangle
    x: Limits
    y: Limits
    parts: list[str] = field(default_factory=list)

    def across(self, x: FloatArray | float) -> FloatArray:
        """Return the x coordinates of values in the figure, points."""
        low, high = self.x
        return np.asarray(self.box.left + (np.asarray(x) - low) * self.box.width / (high - low))

    def down(self, y: FloatArray | float) -> FloatArray:
        """Return the y coordinates of values in the figure, points."""
        low, high = self.y
        return np.asarray(self.box.bottom - (np.asarray(y) - low) * self.box.height / (high - low))

    def line(self, x: FloatArray, y: FloatArray, stroke: Stroke) -> None:
        """Draw a line through points, shape (N,) each; NaN interrupts it."""
        self.path(_polyline(self.across(x), self.down(y)), stroke.style)

    def dots(self, x: FloatArray, y: FloatArray, size: float, colour: str, alpha: float) -> None:
        """Draw points as one path of round caps; those beyond the panel are left out."""
        seen = self._inside(x, y)
        at = zip(self.across(x[seen]), self.down(y[seen]), strict=True)
        d = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in at)
        self.path(d, Stroke(colour, size, alpha=alpha, round=True).style)

    def crosses(self, x: FloatArray, y: FloatArray, size: float, colour: str) -> None:
        """Draw crosses of so many points."""
        half = size / 2
        d = "".join(
            f"M{a - half:.1f} {b - half:.1f}l{size} {size}m0 {-size}l{-size} {size}"
            for a, b in zip(self.across(x), self.down(y), strict=True)
        )
        self.path(d, Stroke(colour, 1.0).style)

    def bars(self, edges: FloatArray, feet: FloatArray, tops: FloatArray, style: str) -> None:
        """Draw filled bars between edges, shape (N, 2), feet and tops, shape (N,), as one path."""
        left, right = self.across(edges).T
        low, high = self.down(feet), self.down(tops)
        d = "".join(
            f"M{a:.1f} {p:.1f}H{b:.1f}V{q:.1f}H{a:.1f}z"
            for a, b, p, q in zip(left, right, low, high, strict=True)
        )
        self.path(d, style)

    def ring(self, radius: float, stroke: Stroke) -> None:
        """Draw a circle around zero, its radius in the values of x."""
        r = float(self.across(radius) - self.across(0.0))
        x, y = float(self.across(-radius)), float(self.down(0.0))
        self.path(f"M{x:.1f} {y:.1f}a{r:.1f} {r:.1f} 0 1 1 0 0.01z", stroke.style)

    def level(self, y: float, stroke: Stroke) -> None:
        """Draw a line over the whole width."""
        self.path(f"M{self.box.left:.1f} {self.down(y):.1f}H{self.box.right:.1f}", stroke.style)

    def upright(self, x: float, stroke: Stroke) -> None:
        """Draw a line over the whole height."""
        self.path(f"M{self.across(x):.1f} {self.box.top:.1f}V{self.box.bottom:.1f}", stroke.style)

    def text(self, x: float, y: float, words: str, style: str = "") -> None:
        """Write words at a place of the figure in points."""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" style="{style}">{escape(shown_lines(words))}</text>'
        )

    def path(self, d: str, style: str) -> None:
        """Draw a path in points, if there is any of it."""
        if d:
            self.parts.append(f'<path d="{d}" style="{style}"/>')

    def frame(self) -> None:
        """Draw the left and the lower edge."""
        box = self.box
        d = f"M{box.left:.1f} {box.top:.1f}V{box.bottom:.1f}H{box.right:.1f}"
        self.path(d, Stroke(MUTED, 0.7).style)

    def y_axis(self, label: str, most: int = 6) -> None:
        """Draw lines, ticks and numbers of y, and what it is."""
        ticks = nice(self.y, most)
        at, left = self.down(ticks), self.box.left
        self.path("".join(f"M{left:.1f} {b:.1f}h{self.box.width:.1f}" for b in at), _GRID)
        self.path("".join(f"M{left:.1f} {b:.1f}h{-TICK}" for b in at), _TICKS)
        for b, words in zip(at, numbers(ticks), strict=True):
            self.text(left - 6, float(b) + 3.5, words, letters("end"))
        middle = self.box.top + self.box.height / 2
        if label:
            self.parts.append(
                f'<text transform="translate(10 {middle:.1f}) rotate(-90)" '
                f'style="{letters("middle")}">{escape(shown_lines(label))}</text>'
            )

    def x_axis(self, label: str) -> None:
        """Draw lines, ticks and numbers of x, and what it is."""
        ticks = nice(self.x, 8)
        self.x_lines(ticks)
        self.x_names(ticks, numbers(ticks))
        self.x_label(label)

    def x_lines(self, ticks: FloatArray) -> None:
        """Draw lines and ticks of x."""
        at, box = self.across(ticks), self.box
        self.path("".join(f"M{a:.1f} {box.top:.1f}v{box.height:.1f}" for a in at), _GRID)
        self.path("".join(f"M{a:.1f} {box.bottom:.1f}v{TICK}" for a in at), _TICKS)

    def x_names(self, ticks: FloatArray, names: Sequence[str]) -> None:
        """Write names at ticks of x."""
        for a, words in zip(self.across(ticks), names, strict=True):
            self.text(float(a), self.box.bottom + 14, words, letters("middle"))

    def x_label(self, label: str) -> None:
        """Write what x is."""
        middle = self.box.left + self.box.width / 2
        self.text(middle, self.box.bottom + 28, label, letters("middle"))

    def _inside(self, x: FloatArray, y: FloatArray) -> FloatArray:
        (left, right), (low, high) = self.x, self.y
        return np.asarray((x >= left) & (x <= right) & (y >= low) & (y <= high))


@dataclass(frozen=True)
class LegendEntry:
    """A line of a legend: its name, and a stroke that shows what it means."""

    name: str
    stroke: Stroke


@dataclass(frozen=True)
class Drawing:
    """A figure of so many inches, with its panels and other parts."""

    height: float
    panels: tuple[Panel, ...]
    parts: list[str] = field(default_factory=list)

    def legend_above(self, entries: Sequence[LegendEntry]) -> None:
        """Write a legend in one line at the top."""
        widths = [SAMPLE + 6 + LETTER * SMALL * len(each.name) + 12 for each in entries]
        x = (PAGE - sum(widths)) / 2
        own = Panel(Rectangle(0, 0, PAGE, TOP), (0, 1), (0, 1), self.parts)
        for entry, width in zip(entries, widths, strict=True):
            own.path(f"M{x:.1f} 11h{SAMPLE}", entry.stroke.style)
            own.text(x + SAMPLE + 6, 14.5, entry.name, letters("start", SMALL))
            x += width


def legend(panel: Panel, entries: Sequence[LegendEntry]) -> None:
    """Write a legend into the upper right corner of a panel."""
    right, y = panel.box.right - 4, panel.box.top + 10
    for entry in entries:
        panel.path(f"M{right - SAMPLE:.1f} {y - 3.2:.1f}h{SAMPLE}", entry.stroke.style)
        panel.text(right - SAMPLE - 6, y, entry.name, letters("end", SMALL))
        y += 13


def usual(height: float) -> Rectangle:
    """Return the room for axes with usual labels in a figure of so many inches."""
    return Rectangle(LEFT, TOP, PAGE - LEFT - RIGHT, POINTS * height - TOP - BOTTOM)


def stacked(height: float, count: int) -> list[Rectangle]:
    """Return the rooms for axes above each other in a figure of so many inches."""
    whole = usual(height)
    each = (whole.height - (count - 1) * GAP) / count
    return [
        Rectangle(whole.left, whole.top + k * (each + GAP), whole.width, each) for k in range(count)
    ]


@as_svg.register
def _(figure: Drawing, name: str, alt: str) -> Markup:
    del name  # nothing inside has a name
    box = f'viewBox="0 0 {PAGE:.1f} {POINTS * figure.height:.1f}"'
    inside = "\n".join([*(part for each in figure.panels for part in each.parts), *figure.parts])
    # words are escaped where they are written
    return Markup(f'<svg {box} role="img" aria-label="{escape(shown_lines(alt))}">{inside}</svg>')  # noqa: S704


def colours(name: str) -> list[str]:
    """Return the colours of a matplotlib colour map, from the lowest to the highest."""
    return [to_hex(each) for each in colormaps[name](np.linspace(0, 1, COLOURS))]


def shades(values: FloatArray, limits: Limits) -> IntArray:
    """Return the colour of each value by its number; those beyond the limits have the last."""
    low, high = limits
    share = (values - low) / (high - low or 1.0)
    return np.asarray(np.clip((share * COLOURS).astype(int), 0, COLOURS - 1))


def paint(colour: str) -> str:
    """Return a colour, or the variable of the page that replaces it."""
    return f"var({VARIABLES[colour]})" if colour in VARIABLES else colour


def fill(colour: str, alpha: float = 1.0) -> str:
    """Return the style of an area."""
    return f"fill:{paint(colour)};stroke:none{opacity(alpha)}"


def opacity(alpha: float) -> str:
    """Return the style of what shines through; nothing where nothing does."""
    return "" if alpha == 1.0 else f";opacity:{alpha}"


def letters(anchor: str, size: float = LABEL, colour: str = INK) -> str:
    """Return the style of words that start, have their middle or end at a place."""
    return f"font-size:{size}px;text-anchor:{anchor};fill:{paint(colour)}"


def spread(values: FloatArray, margin: float = 0.05) -> Limits:
    """Return limits with room around values; around one where there is none."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    room = margin * (high - low) or max(abs(high), 1.0) * margin
    return low - room, high + room


def nice(limits: Limits, most: int) -> FloatArray:
    """Return round numbers between limits, about ``most`` of them at most."""
    ticks = np.asarray(MaxNLocator(most, steps=STEPS).tick_values(*limits))
    room = 1e-6 * (limits[1] - limits[0])
    return np.asarray(ticks[(ticks >= limits[0] - room) & (ticks <= limits[1] + room)])


def numbers(ticks: FloatArray) -> list[str]:
    """Return round numbers with as many digits as distinguish them."""
    if not len(ticks):
        return []
    step = float(np.diff(ticks).min()) if len(ticks) > 1 else max(abs(float(ticks[0])), 1e-9)
    if not 1e-4 <= step <= 1e6:
        return [f"{each:g}".replace("-", "−") for each in ticks]
    digits = next(k for k in range(6) if np.isclose(step, round(step, k), rtol=1e-3))
    return [f"{each + 0.0:.{digits}f}".replace("-", "−") for each in np.round(ticks, digits)]


def _polyline(x: FloatArray, y: FloatArray) -> str:
    """Return a path through points, with a gap at each NaN."""
    pieces, start = [], True
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        if a != a or b != b:
            start = True
            continue
        pieces.append(f"{'M' if start else 'L'}{a:.1f} {b:.1f}")
        start = False
    return "".join(pieces)


_GRID = Stroke(GRID, 0.6).style
_TICKS = Stroke(MUTED, 0.7).style

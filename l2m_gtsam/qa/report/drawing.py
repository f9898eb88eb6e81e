"""A figure of a report, written as SVG without matplotlib: see ``panel``."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from markupsafe import Markup, escape

from l2m_gtsam.qa.report.panel import Box, Panel, Stroke, letters
from l2m_gtsam.qa.report.svg import SMALL, WIDTH, as_svg

POINTS = 72  # of an inch
PAGE = WIDTH * POINTS  # points across
LEFT, RIGHT, TOP, BOTTOM = 57.0, 8.0, 21.6, 36.0  # margins in points, for usual labels
SAMPLE = 20.0  # points of a line in a legend
LETTER = 0.53  # of their size: how wide letters are on average


@dataclass(frozen=True)
class Entry:
    """A line of a legend: its name, and a stroke that shows what it means."""

    name: str
    stroke: Stroke


@dataclass(frozen=True)
class Drawing:
    """A figure of so many inches, with its panels and what stands beside them."""

    height: float
    panels: tuple[Panel, ...]
    parts: list[str] = field(default_factory=list)

    def legend_above(self, entries: Sequence[Entry]) -> None:
        """Write a legend in one line at the top."""
        widths = [SAMPLE + 6 + LETTER * SMALL * len(each.name) + 12 for each in entries]
        x = (PAGE - sum(widths)) / 2
        own = Panel(Box(0, 0, PAGE, TOP), (0, 1), (0, 1), self.parts)
        for entry, width in zip(entries, widths, strict=True):
            own.path(f"M{x:.1f} 11h{SAMPLE}", entry.stroke.style)
            own.text(x + SAMPLE + 6, 14.5, entry.name, letters("start", SMALL))
            x += width


def legend(panel: Panel, entries: Sequence[Entry]) -> None:
    """Write a legend into the upper right corner of a panel."""
    right, y = panel.box.right - 4, panel.box.top + 10
    for entry in entries:
        panel.path(f"M{right - SAMPLE:.1f} {y - 3.2:.1f}h{SAMPLE}", entry.stroke.style)
        panel.text(right - SAMPLE - 6, y, entry.name, letters("end", SMALL))
        y += 13


def usual(height: float) -> Box:
    """Return the room for axes with usual labels in a figure of so many inches."""
    return Box(LEFT, TOP, PAGE - LEFT - RIGHT, POINTS * height - TOP - BOTTOM)


def stacked(height: float, count: int, gap: float = 9.0) -> list[Box]:
    """Return the rooms for axes above each other in a figure of so many inches."""
    whole = usual(height)
    each = (whole.height - (count - 1) * gap) / count
    return [Box(whole.left, whole.top + k * (each + gap), whole.width, each) for k in range(count)]


@as_svg.register
def _(figure: Drawing, name: str, alt: str) -> Markup:
    del name  # nothing inside has a name
    box = f'viewBox="0 0 {PAGE:.1f} {POINTS * figure.height:.1f}"'
    inside = "\n".join([*(part for each in figure.panels for part in each.parts), *figure.parts])
    # words are escaped where they are written
    return Markup(f'<svg {box} role="img" aria-label="{escape(alt)}">{inside}</svg>')  # noqa: S704

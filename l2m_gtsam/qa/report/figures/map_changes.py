"""What changed in a map since its survey, drawn on it: steel that came, went or was moved."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from l2m_gtsam.qa.report.svg import BAD, PAPER, SMALL
from l2m_gtsam.records.map_diary import DatedChange, Happening, MapDiary, between, words_of

GONE = "#0072b2"  # of steel that is no longer there
MOST_LINES = 14  # of the list beside the picture
FADED: Any = {"fill": False, "hatch": "////", "linewidth": 0.0, "alpha": 0.35}


def draw_changes(axes: Axes, diary: MapDiary) -> None:
    """Draw changes by their numbers, moves as arrows, and where earlier readings count less."""
    for stretch in diary.faded:
        corner = np.array(stretch.middle) - stretch.edge / 2
        axes.add_patch(
            Rectangle(tuple(corner), stretch.edge, stretch.edge, edgecolor="0.2", **FADED)
        )
    for number, change in enumerate(diary.changes):
        if change.what is Happening.CAME and change.other is not None:
            start = diary.changes[change.other].source.position[:2]
            arrow: Any = {"arrowstyle": "->", "color": BAD, "linewidth": 1.4}
            axes.annotate("", tuple(change.source.position[:2]), tuple(start), arrowprops=arrow)
        draw_change(axes, change, str(number + 1))


def draw_change(axes: Axes, change: DatedChange, name: str) -> None:
    """Draw a source: filled where it came, empty where it went, with two sigmas around it."""
    source, came = change.source, change.what is Happening.CAME
    colour = BAD if came else GONE
    x, y = source.position[:2]
    ends = np.array([source.position - source.half_axis, source.position + source.half_axis])
    axes.plot(*ends[:, :2].T, color=colour, linewidth=4, solid_capstyle="round")
    radius = 2 * float(np.max(source.position_sigma[:2]))
    axes.add_patch(Circle((x, y), radius, fill=False, edgecolor=colour, linewidth=1.0))
    face = colour if came else PAPER
    axes.plot(x, y, "o", color=face, markersize=14, markeredgecolor=colour, markeredgewidth=1.5)
    style: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "fontweight": "bold"}
    axes.annotate(name, (x, y), color="white" if came else colour, **style)


def list_changes(axes: Axes, diary: MapDiary) -> None:
    """Write what happened when, the last first, into axes of its own."""
    axes.axis("off")
    numbers = list(reversed(range(len(diary.changes))))
    lines = [
        f"{number + 1}  {words_of(diary, number)}, between {between(diary, number)}"
        for number in numbers[:MOST_LINES]
    ]
    if len(numbers) > MOST_LINES:
        lines.append(f"and {len(numbers) - MOST_LINES} earlier ones: see `l2m map info`")
    if not numbers:
        lines = ["nothing came or went that the drives noticed"]
    if diary.faded:
        lines += ["", "hatched: readings before a drive count less there"]
    drives = len(diary.drives) - 1
    title = f"What changed in {drives} drives since {diary.drives[0].day}"
    if diary.drives[0].ended is None:
        title = f"What changed in {drives} drives since the survey"
    axes.set_title(title, loc="left", fontsize=11)
    axes.text(0.0, 1.0, "\n".join(lines), va="top", transform=axes.transAxes, fontsize=9)

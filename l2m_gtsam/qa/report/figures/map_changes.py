"""What changed in a map since its survey, drawn on it: steel that came, went or was moved."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from l2m_gtsam.qa.report.svg import SMALL
from l2m_gtsam.records.map_diary import (
    DatedChange,
    Happening,
    MapDiary,
    between,
    doubtful,
    words_of,
)
from l2m_gtsam.records.places import ChangedSource

# Of steel that came, and of steel that is no longer there: seen on the map's colours by all.
HERE, GONE = "#d55e00", "#56b4e9"
ONE_PLACE_M = 0.3  # so near, changes are marked together
MOST_LINES = 14  # of the list beside the picture
WIDEST = 52  # letters of its lines
FADED: Any = {"fill": False, "hatch": "////", "linewidth": 0.0, "alpha": 0.35}
ARROW: Any = {"arrowstyle": "-|>", "color": HERE, "linewidth": 1.6, "shrinkA": 9, "shrinkB": 9}


def draw_changes(axes: Axes, diary: MapDiary) -> None:
    """Draw changes by their numbers, moves as arrows, and where earlier readings count less."""
    for stretch in diary.faded:
        corner = np.array(stretch.middle) - stretch.edge / 2
        axes.add_patch(
            Rectangle(tuple(corner), stretch.edge, stretch.edge, edgecolor="0.2", **FADED)
        )
    for change in diary.changes:
        if not change.went and change.other is not None:
            start = diary.changes[change.other].source.position[:2]
            axes.annotate("", tuple(change.source.position[:2]), tuple(start), arrowprops=ARROW)
    for numbers in together(diary):
        name = ", ".join(str(number + 1) for number in numbers)
        draw_change(axes, diary.changes[numbers[-1]], name)


def together(diary: MapDiary) -> list[list[int]]:
    """Return the indices of changes place by place, each place's in order of time."""
    places: list[list[int]] = []
    for number, change in enumerate(diary.changes):
        at = change.source.position[:2]
        for place in places:
            first = diary.changes[place[0]].source.position[:2]
            if np.linalg.norm(at - first) < ONE_PLACE_M:
                place.append(number)
                break
        else:
            places.append([number])
    return places


def draw_change(axes: Axes, change: DatedChange, name: str) -> None:
    """Draw a source: filled where it came, empty where it went, with two sigmas around it."""
    source, colour = change.source, GONE if change.went else HERE
    x, y = source.position[:2]
    draw_extent(axes, source, colour, 1.0)
    half = change.what is Happening.EITHER
    face: Any = {"fillstyle": "bottom" if half else "none" if change.went else "full"}
    face |= {"markerfacecolor": colour, "markerfacecoloralt": "white"}
    axes.plot(x, y, "o", markersize=10, markeredgecolor=colour, markeredgewidth=2.5, **face)
    style: Any = {"xytext": (8, 6), "textcoords": "offset points", "fontsize": SMALL + 1}
    box: Any = {"facecolor": "white", "edgecolor": colour, "alpha": 0.9, "pad": 1.5}
    axes.annotate(name, (x, y), color="black", bbox=box, **style)


def draw_extent(axes: Axes, source: ChangedSource, colour: str, width: float) -> None:
    """Draw how long a source is, and two sigmas of its place as a line of so many points."""
    ends = np.array([source.position - source.half_axis, source.position + source.half_axis])
    axes.plot(*ends[:, :2].T, color=colour, linewidth=4, solid_capstyle="round")
    x, y = source.position[:2]
    radius = 2 * float(np.max(source.position_sigma[:2]))
    axes.add_patch(Circle((x, y), radius, fill=False, edgecolor=colour, linewidth=width))


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
    lines += ["", "full: came; empty: went; half: either; arrow: moved"] if numbers else []
    lines += textwrap.wrap(doubtful(diary) or "", WIDEST)
    if diary.faded:
        lines += ["hatched: readings before a drive count less there"]
    drives = len(diary.drives) - 1
    since = "the survey" if diary.drives[0].ended is None else diary.drives[0].day
    title = f"What changed in {'one drive' if drives == 1 else f'{drives} drives'} since {since}"
    axes.set_title(title, loc="left", fontsize=11)
    axes.text(0.0, 1.0, "\n".join(lines), va="top", transform=axes.transAxes, fontsize=9)

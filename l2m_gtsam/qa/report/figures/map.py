"""The map and the drive through it, and what a sensor's readings leave over it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.errors import MapError
from l2m_gtsam.maps.field_map import FieldMap, Remembering
from l2m_gtsam.qa.metrics.assemble import MapSlice, slice_map
from l2m_gtsam.qa.report.drawing import (
    COLOURS,
    LEFT,
    PAGE,
    POINTS,
    Drawing,
    LegendEntry,
    Panel,
    Rectangle,
    Stroke,
    colours,
    fill,
    legend,
    nice,
    numbers,
    shades,
    spread,
)
from l2m_gtsam.qa.report.figures.map_changes import draw_changes, draw_extent, list_changes
from l2m_gtsam.qa.report.hover import axes_image, places, some_and_marked
from l2m_gtsam.qa.report.svg import BAD, PAPER, SMALL, WIDTH, new_figure
from l2m_gtsam.records.calibration import Disagreement
from l2m_gtsam.records.metrics import MapPicture, Metrics, Series
from l2m_gtsam.records.places import ChangedSource
from l2m_gtsam.records.record import Row, Rows

CELLS = 240  # along the longer side of a map
# Of colour bars: a drive is wider than high more often than not.
BELOW: Any = {"location": "bottom", "shrink": 0.7, "aspect": 40, "pad": 0.02}


def strength_figure(
    metrics: Metrics, stretches: Sequence[Disagreement], sources: Sequence[ChangedSource] = ()
) -> Figure:
    """Draw the field of the map, the drive, and where the place has changed."""
    figure, axes = strength_background(metrics.map)
    _drive(axes, metrics)
    for stretch in stretches:
        axes.plot(
            *zip(stretch.p_from[:2], stretch.p_to[:2], strict=True),
            "-X",
            color=BAD,
            linewidth=3,
            markersize=7,
            markeredgecolor=PAPER,
        )
    for number, source in enumerate(sources, start=1):
        draw_source(axes, source, str(number))
    return figure


def draw_source(axes: Axes, source: ChangedSource, name: str) -> None:
    """Draw where a source is, how long it is, and how well its place is known."""
    x, y = source.position[:2]
    draw_extent(axes, source, BAD, 1.2)
    axes.plot(x, y, "o", color=BAD, markersize=15, markeredgecolor=PAPER)
    style: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "fontweight": "bold"}
    axes.annotate(name, (x, y), color="white", **style)


def sigma_figure(metrics: Metrics) -> Figure:
    """Draw the map's standard deviation along the drive."""
    label = "standard deviation per axis (µT)"
    figure, axes = _map(metrics.map, metrics.map.sigma, label, "cividis")
    _drive(axes, metrics)
    return figure


def residual_figure(series: Series) -> Drawing:
    """Draw the length of a sensor's residuals where they were read."""
    place, residual = np.array(series.place), np.array(series.residual)
    wrong = np.array(series.rejected, dtype=bool)
    size = np.linalg.norm(residual, axis=1)
    high = float(np.quantile(size[~wrong], 0.98)) if (~wrong).any() else 1.0
    extent = np.ptp(place[:, :2], axis=0)
    height = height_of(extent)
    room = Rectangle(LEFT, 8, PAGE - LEFT - 8, POINTS * height - 8 - 80)
    panel = _equal(room, place[:, :2])
    panel.x_axis("x (m)")
    panel.y_axis("y (m)", max(2, int(panel.box.height / 22)))
    shade = shades(size, (0.0, high))
    # Bright ones above: they are what is looked for.
    for number, colour in enumerate(colours("viridis")):
        own = ~wrong & (shade == number)
        panel.dots(place[own, 0], place[own, 1], 3.2, colour, 1.0)
    panel.crosses(place[wrong, 0], place[wrong, 1], 5, BAD)
    panel.frame()
    if wrong.any():
        legend(panel, [LegendEntry("× rejected", Stroke(BAD, 0))])
    bar = _bar(Rectangle(90, POINTS * height - 40, PAGE - 180, 6), high)
    figure, rows = Drawing(height, (panel, bar)), some_and_marked(wrong)
    words = [
        f"{series.seconds[k]:.1f} s, x {place[k, 0]:.2f} m, y {place[k, 1]:.2f} m: {size[k]:.2f} µT"
        f"{', rejected' if wrong[k] else ''}"
        for k in rows
    ]
    places(figure, panel, place[rows, :2], words)
    return figure


def _equal(room: Rectangle, places: FloatArray) -> Panel:
    """Return axes with one scale that hold places, shape (N, 2), in the middle of a room."""
    (left, right), (low, high) = (
        spread(np.append(v, [v.mean() - 0.05, v.mean() + 0.05])) for v in places.T
    )
    scale = min(room.width / (right - left), room.height / (high - low))
    width, height = scale * (right - left), scale * (high - low)
    corner = room.left + (room.width - width) / 2, room.top + (room.height - height) / 2
    return Panel(Rectangle(*corner, width, height), (left, right), (low, high))


def _bar(box: Rectangle, high: float) -> Panel:
    """Draw the scale of colours."""
    bar = Panel(box, (0.0, high or 1.0), (0.0, 1.0))
    steps = np.linspace(*bar.x, COLOURS + 1)
    # Each to the end, below the next: no seam between two.
    for low, colour in zip(steps[:-1], colours("viridis"), strict=True):
        bar.bars(np.array([[low, bar.x[1]]]), np.zeros(1), np.ones(1), fill(colour))
    ticks = nice(bar.x, 6)
    bar.x_names(ticks, numbers(ticks))
    bar.x_label("length of the residual (µT)")
    return bar


def wide(extent: FloatArray) -> tuple[Figure, Axes]:
    """Return a figure as high as a place of this extent, shape (2,), asks for."""
    figure = new_figure(height_of(extent))
    return figure, figure.add_subplot()


def height_of(extent: FloatArray) -> float:
    """Return how many inches a figure of a place of this extent, shape (2,), is high."""
    height = 0.85 * WIDTH * float(extent[1]) / max(float(extent[0]), 0.1)
    return float(np.clip(height + 1.3, 2.0, 4.8))


def strength_background(picture: MapPicture) -> tuple[Figure, Axes]:
    """Draw the field of a map, to draw on."""
    return _map(picture, picture.strength, "field strength (µT)", "viridis")


def _map(picture: MapPicture, values: Rows, label: str, colours: str) -> tuple[Figure, Axes]:
    left, right, bottom, top = picture.extent
    figure, axes = wide(np.array([right - left, top - bottom]))
    draw_map(figure, axes, np.array(values), picture.extent, label, colours, **BELOW)
    axes.set_xlabel(f"x (m), at z = {picture.height:.2f} m; blank: no data")
    axes.grid(visible=False)
    axes_image(axes, np.array(values), picture.extent, "µT")
    return figure, axes


def draw_map(
    figure: Figure, axes: Axes, image: FloatArray, extent: Row, label: str, colours: str, **bar: Any
) -> None:
    """Draw values over the map, its colours from the first to the last hundredth of them.

    Parameters
    ----------
    figure, axes
        To draw into.
    image
        Values on a grid, NaN where there are none, shape (rows, columns).
    extent
        Left, right, bottom, top in metres.
    label, bar
        What the values are, and how the bar of colours lies.
    colours
        Matplotlib's name of them.
    """
    left, right, bottom, top = extent
    known = image[np.isfinite(image)]
    low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
    drawn = axes.imshow(
        image, origin="lower", extent=(left, right, bottom, top), cmap=colours, vmin=low, vmax=high
    )
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    figure.colorbar(drawn, ax=axes, label=label, **bar)


def _drive(axes: Axes, metrics: Metrics) -> None:
    path = np.array(metrics.drive.path)[:, :2].T
    axes.plot(*path, color="white", linewidth=2.4)
    axes.plot(*path, color="black", linewidth=0.9)
    starts = [0, *(np.flatnonzero(np.isnan(path[0])) + 1)]
    for k, first in enumerate(starts):
        name = "start" if len(starts) == 1 else f"start {k + 1}"
        mark(axes, path[:, first], name)


def mark(axes: Axes, place: FloatArray, name: str) -> None:
    """Mark and name a place, shape (2,), on a map."""
    axes.plot(*place, "o", color="white", markeredgecolor="black", markersize=6)
    mark_name(axes, place, name)


def mark_name(axes: Axes, place: FloatArray, name: str) -> None:
    """Name a place, shape (2,), on a map."""
    axes.annotate(
        name,
        tuple(place),
        xytext=(6, 6),
        textcoords="offset points",
        fontsize=SMALL,
        color="black",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
    )


def map_figure(field_map: FieldMap, height: float | None) -> Figure:
    """Draw strength and uncertainty of a map at a height (the middle of its readings if None).

    Raises
    ------
    MapError
        The map has no data at this height.
    """
    lower, upper = field_map.summary.lower, field_map.summary.upper
    level = float(lower[2] + upper[2]) / 2 if height is None else height
    cut = slice_map(field_map, lower[:2], upper[:2], level, CELLS)
    if not np.isfinite(cut.strength).any():
        raise MapError(
            f"the map has no data at z = {level:g} m, its readings run from {lower[2]:.2f} to "
            f"{upper[2]:.2f} m"
        )
    diary = field_map.diary if isinstance(field_map, Remembering) else None
    wide_enough = 12 if diary is None else 17
    figure = Figure(figsize=(wide_enough, 5), layout="constrained", dpi=130)
    columns = figure.add_gridspec(1, 2 if diary is None else 3)
    strength = figure.add_subplot(columns[0])
    sigma = figure.add_subplot(columns[1], sharex=strength, sharey=strength)
    _draw_slice(figure, strength, cut, cut.strength, "field strength (uT)", "viridis")
    _draw_slice(figure, sigma, cut, cut.sigma, "standard deviation per axis (uT)", "cividis")
    if diary is not None:
        draw_changes(strength, diary)
        list_changes(figure.add_subplot(columns[2]), diary)
    figure.suptitle(f"Magnetic map at z = {level:.2f} m")
    return figure


def _draw_slice(
    figure: Figure, axes: Axes, cut: MapSlice, image: FloatArray, label: str, colours: str
) -> None:
    draw_map(figure, axes, image, cut.extent, label, colours, shrink=0.8)
    axes.set_facecolor("0.93")

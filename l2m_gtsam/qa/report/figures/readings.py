"""What a sensor read along the drive, and from which directions the field came."""

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.report.drawing import (
    PAGE,
    Drawing,
    LegendEntry,
    Panel,
    Rectangle,
    Stroke,
    fill,
    letters,
    nice,
    numbers,
    spread,
    stacked,
)
from l2m_gtsam.qa.report.figures.map import residual_figure
from l2m_gtsam.qa.report.hover import places, some, some_and_marked, strips
from l2m_gtsam.qa.report.svg import AXES, BAD, GRID, INK, MUTED, SMALL, X, Y
from l2m_gtsam.records.metrics import SensorMetrics, Series

BETWEEN = 0.04  # of all drives' time, between two drives in a figure
ZERO = Stroke(MUTED, 0.7)
BEFORE = Stroke(X, 0.9)
MOST = 8  # numbers along the time
MAP = Stroke(INK, 2.2, alpha=0.35)
DISKS = 2.7  # inches
SIZE = 164.0  # points of a disk with its room
ENDS = (-1.15, 1.15)
AXIS = letters("start", colour=MUTED)
AFTER = Stroke(Y, 1.0, dashes=(3.7, 1.6))


def series_figures(series: Series) -> dict[str, Figure | Drawing]:
    """Return all that is drawn of a sensor's readings, by the keys of pages."""
    return {
        "curves": curves_figure(series),
        "residuals": residuals_figure(series),
        "place": residual_figure(series),
    }


def residuals_figure(series: Series) -> Drawing:
    """Draw residuals over time, an axis each, with rejected readings marked."""
    height = 3.8
    seconds, wrong = along(series), np.array(series.rejected, dtype=bool)
    residual = np.array(series.residual)
    limit = 1.3 * float(np.quantile(np.abs(residual[~wrong]), 0.995)) if (~wrong).any() else 1.0
    ends = (-1.05 * limit, 1.05 * limit)
    panels = [Panel(box, spread(seconds), ends) for box in stacked(height, 3)]
    _time_axis(panels, series)
    for k, panel in enumerate(panels):
        panel.y_axis(f"{'xyz'[k]} (µT)", 4)
        panel.level(0, ZERO)
        panel.dots(seconds[~wrong], residual[~wrong, k], 2.2, AXES[k], 0.75)
        # Those beyond the picture are drawn at its edge.
        shown = np.clip(residual[wrong, k], -limit, limit)
        panel.crosses(seconds[wrong], shown, 4, BAD)
        panel.frame()
    figure, rows = Drawing(height, tuple(panels)), some_and_marked(wrong)
    strips(figure, seconds[rows], residual_words(series, rows))
    return figure


def residual_words(series: Series, rows: IntArray) -> list[str]:
    """Return what the residuals of some readings are, a line each."""
    residual = np.array(series.residual)[rows]
    return [
        f"{series.seconds[k]:.1f} s: x {x:+.2f}, y {y:+.2f}, z {z:+.2f} µT"
        f"{', rejected' if series.rejected[k] else ''}"
        for k, (x, y, z) in zip(rows, residual, strict=True)
    ]


def curves_figure(series: Series) -> Drawing:
    """Draw readings before and after the calibration beside those of the map, an axis each."""
    height = 4.6
    ends, times = _ends(series), along(series)
    seconds = np.insert(times, ends, np.nan)
    lines = [
        np.insert(np.array(each), ends, np.nan, axis=0)
        for each in (series.before, series.map, series.after)
    ]
    panels = [
        Panel(box, spread(times), spread(np.concatenate([line[:, k] for line in lines])))
        for k, box in enumerate(stacked(height, 3))
    ]
    _time_axis(panels, series)
    for k, panel in enumerate(panels):
        panel.y_axis(f"{'xyz'[k]} (µT)")
        for line, stroke in zip(lines, (BEFORE, MAP, AFTER), strict=True):
            panel.line(seconds, line[:, k], stroke)
        panel.frame()
    figure = Drawing(height, tuple(panels))
    names = ("before (BC)", "map (MR)", "after (AC)")
    figure.legend_above(
        [LegendEntry(*each) for each in zip(names, (BEFORE, MAP, AFTER), strict=True)]
    )
    rows = some(len(times))
    strips(figure, times[rows], _curve_words(series, rows))
    return figure


def _curve_words(series: Series, rows: IntArray) -> list[str]:
    """Return what some readings are before and after, and what the map has there."""
    before, after, there = (
        _vectors(np.array(each)[rows]) for each in (series.before, series.after, series.map)
    )
    return [
        f"{series.seconds[k]:.1f} s: before {b}, after {a}, map {m} µT"
        for k, b, a, m in zip(rows, before, after, there, strict=True)
    ]


def _vectors(values: FloatArray) -> list[str]:
    return [f"({x:.1f}, {y:.1f}, {z:.1f})" for x, y, z in values]


def along(series: Series) -> FloatArray:
    """Return the x coordinates of readings in a figure, shape (N,): drives one after the other."""
    seconds = np.array(series.seconds)
    if series.drive is None:
        return seconds
    return np.asarray(seconds + _starts(series)[np.array(series.drive)])


def _time_axis(panels: list[Panel], series: Series) -> None:
    """Draw the common axis of time; several drives are numbered, and each has its own time."""
    last = panels[-1]
    if series.drive is None:
        for panel in panels:
            panel.x_lines(nice(panel.x, MOST))
        last.x_names(nice(last.x, MOST), numbers(nice(last.x, MOST)))
        last.x_label("time (s)")
        return
    starts, lengths = _starts(series), _lengths(series)
    between = BETWEEN * float(lengths.sum())
    for panel in panels:
        panel.x_lines(starts + lengths)
        gaps = np.column_stack([starts - between, starts])[1:]
        low, high = (np.full(len(gaps), each) for each in panel.y)
        panel.bars(gaps, low, high, fill(GRID))
    for k, middle in enumerate(starts + lengths / 2):
        name = f"drive {k + 1}" if len(starts) <= 4 else str(k + 1)
        top = panels[0]
        top.text(float(top.across(middle)), top.box.top - 3, name, letters("middle", SMALL))
    last.x_names(starts + lengths, [f"{each:.0f}" for each in lengths])
    last.x_label("time (s): the end of each drive, from its own start")


def _ends(series: Series) -> IntArray:
    """Return the first reading of each drive but the first."""
    drive = np.zeros(len(series.seconds)) if series.drive is None else np.array(series.drive)
    return np.flatnonzero(np.diff(drive)) + 1


def _lengths(series: Series) -> FloatArray:
    """Return how long each drive lasts as this sensor saw it, in seconds."""
    drive, seconds = np.array(series.drive), np.array(series.seconds)
    return np.array([seconds[drive == k].max(initial=0.0) for k in range(drive.max() + 1)])


def _starts(series: Series) -> FloatArray:
    """Return where each drive starts in a figure."""
    lengths = _lengths(series)
    between = BETWEEN * float(lengths.sum())
    return np.concatenate([[0.0], np.cumsum(lengths + between)[:-1]])


def directions_figure(sensor: SensorMetrics) -> Drawing:
    """Draw the directions on two disks: the upper and the lower half of space."""
    b = np.array(sensor.series.map)
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    panels = []
    for k, (side, name, colour) in enumerate(((1, "upward", X), (-1, "downward", Y))):
        own = unit[np.sign(unit[:, 2]) == side]
        x, y = equal_area(own).T
        panel = Panel(Rectangle(k * PAGE / 2 + (PAGE / 2 - SIZE) / 2, 24, SIZE, SIZE), ENDS, ENDS)
        for elevation in (30, 60):
            panel.ring(np.sqrt(1 - np.sin(np.deg2rad(elevation))), Stroke(GRID, 0.8))
        panel.ring(1.0, Stroke(MUTED, 0.9))
        panel.dots(x, y, 2.4, colour, 0.6)
        middle, top = float(panel.across(0)), float(panel.down(1.02))
        title = f"{name}: {len(own) / len(unit):.0%}"
        panel.text(middle, 16, title, letters("middle", 10.5))
        panel.text(float(panel.across(1.02)), float(panel.down(0)) + 3, "x", AXIS)
        panel.text(middle, top - 2, "y", letters("middle", colour=MUTED))
        panels.append(panel)
    figure = Drawing(DISKS, tuple(panels))
    for panel, side in zip(panels, (1, -1), strict=True):
        own = b[np.sign(b[:, 2]) == side]
        own = own[some(len(own))]
        unit = own / np.linalg.norm(own, axis=1, keepdims=True)
        places(figure, panel, equal_area(unit), _direction_words(own))
    return figure


def _direction_words(b: FloatArray) -> list[str]:
    """Return azimuth, elevation and strength of fields in the lidar frame, shape (N, 3)."""
    azimuth = np.rad2deg(np.arctan2(b[:, 1], b[:, 0]))
    strength = np.linalg.norm(b, axis=1)
    elevation = np.rad2deg(np.arcsin(b[:, 2] / strength))
    return [
        f"azimuth {a:.0f}°, elevation {e:.0f}°: {s:.1f} µT"
        for a, e, s in zip(azimuth, elevation, strength, strict=True)
    ]


def equal_area(unit: FloatArray) -> FloatArray:
    """Return directions of one half of space, shape (N, 3), on a disk of radius 1, (N, 2).

    Lambert's azimuthal projection from the nearer pole of z: equal areas stay equal.
    """
    z = np.abs(unit[:, 2])
    r = np.sqrt(np.clip(1 - z, 0, 1))
    flat = np.hypot(unit[:, 0], unit[:, 1])
    scale = np.divide(r, flat, out=np.zeros_like(r), where=flat > 0)
    return np.asarray(unit[:, :2] * scale[:, None])

"""A calibration on another drive: all sensors beside each other."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from l2m_gtsam.qa.report.svg import BAD, GOOD, GRID, INK, MUTED, X, Y, new_figure, short_name
from l2m_gtsam.records.validation import ValidatedSensor

ROW = 0.26  # inches of a sensor
ROUND = 0.15  # of the axis of ratios: room around the outermost


def field_errors_figure(sensors: Sequence[ValidatedSensor]) -> Figure:
    """Draw the mean distance of readings to the map, as read and corrected, a row per sensor."""
    figure, axes = _rows(sensors)
    for k, sensor in enumerate(sensors):
        before, after = sensor.before.mean, sensor.after.mean
        axes.plot([after, before], [k, k], "-", color=GRID, linewidth=2.5)
    rows = np.arange(len(sensors))
    axes.plot([s.before.mean for s in sensors], rows, "s", color=X, label="before")
    axes.errorbar(
        [s.after.mean for s in sensors],
        rows,
        xerr=[[min(s.after.std, 0.9 * s.after.mean) for s in sensors], _stds(sensors)],
        fmt="o",
        color=Y,
        label="after, ± 1 std",
    )
    _logarithmic(axes)
    axes.set(xlabel="distance to the map's field (µT)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _stds(sensors: Sequence[ValidatedSensor]) -> list[float]:
    return [each.after.std for each in sensors]


def nis_figure(sensors: Sequence[ValidatedSensor]) -> Figure:
    """Draw the normalised innovation squared of each sensor in the band where chance puts it."""
    figure, axes = _rows(sensors)
    for k, sensor in enumerate(sensors):
        nis, good = sensor.nis, sensor.nis.consistent
        band = [nis.low / nis.freedom, nis.high / nis.freedom]
        axes.plot(band, [k, k], "-", color=GRID, linewidth=9, solid_capstyle="butt")
        axes.plot(nis.ratio, k, "o" if good else "X", color=GOOD if good else BAD, markersize=6)
    axes.axvline(1, color=MUTED, linewidth=0.8)
    values = [each.nis.ratio for each in sensors]
    if max(values) > 3:
        _logarithmic(axes)
    axes.plot([], [], "-", color=GRID, linewidth=6, label="95 % of all cases")
    axes.plot([], [], "o", color=INK, label="found")
    axes.margins(x=ROUND)
    axes.set(xlabel="normalised innovation squared per degree of freedom")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _logarithmic(axes: Axes) -> None:
    """Count along x in decades, with plain numbers: mathematics is text in these figures."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / (1 + ROUND), high * (1 + ROUND))
    wide = high > 20 * low
    steps = [1.0] if wide else [1.0, 2.0, 5.0]
    axes.xaxis.set_major_locator(LogLocator(subs=steps))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _rows(sensors: Sequence[ValidatedSensor]) -> tuple[Figure, Axes]:
    figure = new_figure(1.5 + ROW * len(sensors))
    axes = figure.add_subplot()
    axes.set_yticks(range(len(sensors)), [short_name(each.sensor) for each in sensors])
    axes.set_ylim(len(sensors) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    return figure, axes

"""Several drives of a sensor, or several sensors of a drive, beside each other."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.hover import axes_places, axes_strips
from l2m_gtsam.qa.report.svg import (
    BAD,
    GOOD,
    GRID,
    INK,
    MUTED,
    SMALL,
    X,
    Y,
    new_figure,
    plain_decades,
    short_name,
)
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.repeatability import Repeatability
from l2m_gtsam.records.validation import ValidatedSensor
from l2m_gtsam.text import with_sigma

MANY = 12  # drives beyond which only some are numbered
ROW = 0.26  # inches of a sensor
ROUND = 0.15  # of the axis of ratios: room around the outermost


def drives_figure(sensor: SensorCalibration, found: Repeatability) -> Figure:
    """Draw place and offset by each drive less those of all together, with standard deviations."""
    figure = new_figure(3.6)
    parts = figure.subplots(2, 3, sharex=True, sharey="row")
    whole = sensor.vector()
    sigma = np.sqrt(np.diag(sensor.covariance))
    count = len(found.drives)
    numbers = range(0, count, max(1, -(-count // MANY)))
    for axes in parts[-1]:
        axes.set_xticks(numbers, [str(k + 1) for k in numbers], fontsize=SMALL)
        axes.set_xlim(-0.6, count - 0.4)
    for axes, at in zip(parts.ravel(), (0, 1, 2, 12, 13, 14), strict=True):
        name, unit, factor = ("t", "mm", 1e3) if at < 3 else ("H", "µT", 1.0)
        values = [
            (factor * (each.estimate[at] - whole[at]), factor * each.sigma[at])
            for each in found.drives
        ]
        _draw(axes, np.array(values), factor * float(sigma[at]))
        axes.set_title(f"{name}{'xyz'[at % 3]}")
        if at % 3 == 0:
            axes.set_ylabel(f"off by ({unit})")
        words = [
            f"drive {k}, {each.bag}: {with_sigma(*own, unit, signed=True)}"
            for k, (each, own) in enumerate(zip(found.drives, values, strict=True), start=1)
        ]
        axes_strips(axes, np.arange(float(count)), words)
    parts[-1][1].set_xlabel("drive")
    return figure


def _draw(axes: Axes, values: FloatArray, sigma: float) -> None:
    """Draw differences with their sigmas, shape (P, 2), over the band of all drives together."""
    if np.isfinite(sigma):
        axes.axhspan(-sigma, sigma, color=GRID)
    axes.axhline(0, color=MUTED, linewidth=0.7)
    known = np.isfinite(values).all(axis=1)
    place = np.arange(len(values))
    axes.errorbar(
        place[known],
        values[known, 0],
        yerr=values[known, 1],
        fmt="o",
        color=X,
        ecolor=INK,
        elinewidth=1.0,
        capsize=3,
        markersize=4.5,
    )
    axes.plot(place[~known], np.zeros(np.sum(~known)), "x", color=MUTED, markersize=5)


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
        xerr=[
            [min(s.after.std, 0.9 * s.after.mean) for s in sensors],
            [s.after.std for s in sensors],
        ],
        fmt="o",
        color=Y,
        label="after, ± 1 std",
    )
    words = [
        f"{s.sensor}: before {s.before.mean:.2f}, after {s.after.mean:.2f} ± {s.after.std:.2f} µT"
        for s in sensors
    ]
    for at in ([s.before.mean for s in sensors], [s.after.mean for s in sensors]):
        axes_places(axes, np.column_stack([at, rows]), words)
    _logarithmic(axes)
    axes.set(xlabel="distance to the map's field (µT)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


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
    words = [
        f"{s.sensor}: {s.nis.ratio:.2f}; 95 % of cases: {s.nis.low / s.nis.freedom:.2f} to "
        f"{s.nis.high / s.nis.freedom:.2f}"
        for s in sensors
    ]
    axes_places(axes, np.column_stack([values, np.arange(len(sensors))]), words)
    if max(values) > 3:
        _logarithmic(axes)
    axes.plot([], [], "-", color=GRID, linewidth=6, label="95 % of all cases")
    axes.plot([], [], "o", color=INK, label="found")
    axes.margins(x=ROUND)
    axes.set(xlabel="normalised innovation squared per degree of freedom")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _logarithmic(axes: Axes) -> None:
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / (1 + ROUND), high * (1 + ROUND))
    plain_decades(axes.xaxis, high > 20 * low)


def _rows(sensors: Sequence[ValidatedSensor]) -> tuple[Figure, Axes]:
    figure = new_figure(1.5 + ROW * len(sensors))
    axes = figure.add_subplot()
    axes.set_yticks(range(len(sensors)), [short_name(each.sensor) for each in sensors])
    axes.set_ylim(len(sensors) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    return figure, axes

"""Trends: what each drive of a vehicle found for a sensor, over time."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num, num2date
from matplotlib.figure import Figure

from l2m_gtsam.data import BoolArray, FloatArray
from l2m_gtsam.qa.fleet import by_sensor
from l2m_gtsam.qa.report.hover import axes_strips
from l2m_gtsam.qa.report.svg import AXES, BAD, INK, MUTED, dots, plain_figure
from l2m_gtsam.records.fleet import DATE, FleetRow
from l2m_gtsam.text import with_sigma

SIGMAS = 2  # of the bars
ROOM = 1.15  # around what is drawn
LEAST_DAYS = 1 / 24  # shown when all drives are of one time


@dataclass(frozen=True)
class Trend:
    """One sensor of a vehicle over N drives with dates, in order of time.

    Attributes
    ----------
    vehicle, sensor
        Names.
    days
        Dates as Matplotlib counts them, shape (N,).
    values, sigmas
        t less its weighted mean in millimetres and the length of H in microtesla, shape (N, 4).
    outlying
        For the x, y and z of t, and H: whether the drive is marked for it, shape (N, 4).
    failed
        Whether the verdict is FAIL, shape (N,).
    outliers
        Number of drives that are marked, for whatever parameter.
    """

    vehicle: str
    sensor: str
    days: FloatArray
    values: FloatArray
    sigmas: FloatArray
    outlying: BoolArray
    failed: BoolArray
    outliers: int


def trends(rows: Sequence[FleetRow]) -> list[Trend]:
    """Return the trends of all sensors that have two drives with dates at least."""
    found = []
    for (vehicle, sensor), places in by_sensor(rows).items():
        dated = [rows[k] for k in places if rows[k].date]
        if len(dated) > 1:
            found.append(_trend(vehicle, sensor, sorted(dated, key=lambda each: each.date)))
    return found


def weighted_mean(values: FloatArray, sigmas: FloatArray, counts: BoolArray) -> FloatArray:
    """Return the mean of each column, weighted with one over the variances; NaN without any.

    Parameters
    ----------
    values, sigmas
        Shape (N, K); what is not finite does not count.
    counts
        Whether a value counts, shape (N, K).
    """
    known = np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0) & counts
    weight = np.where(known, 1 / np.where(known, sigmas, 1) ** 2, 0.0)
    total = weight.sum(axis=0)
    summed = np.sum(weight * np.where(known, values, 0.0), axis=0)
    return np.asarray(np.divide(summed, total, out=np.full(len(total), np.nan), where=total > 0))


def trend_figure(trend: Trend) -> Figure:
    """Draw a trend: an axis each for the position, and one for the length of H."""
    figure = plain_figure(4.8)
    parts = figure.subplots(4, 1, sharex=True)
    labels = ("x (mm)", "y (mm)", "z (mm)", "|H| (µT)")
    for k, (axes, label) in enumerate(zip(parts, labels, strict=True)):
        if k < 3:
            axes.axhline(0, color=MUTED, linewidth=0.7)
        _draw(axes, trend, k)
        axes.set_ylabel(label)
    locator = AutoDateLocator(minticks=3, maxticks=6)
    parts[-1].xaxis.set_major_locator(locator)
    parts[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator, show_offset=True))
    low, high = trend.days.min(), trend.days.max()
    margin = max(0.04 * (high - low), LEAST_DAYS / 2)
    parts[-1].set_xlim(low - margin, high + margin)
    top, bottom = parts[0].get_position(), parts[-1].get_position()
    height = (top.y1 - bottom.y0) / bottom.height
    axes_strips(parts[-1], trend.days, _words(trend, labels), height)
    return figure


def _words(trend: Trend, labels: Sequence[str]) -> list[str]:
    """Return date, values and sigmas of each drive."""
    lines = [
        "; ".join(
            f"{label} {with_sigma(value, sigma)}{', outlier' if outlying else ''}"
            for label, value, sigma, outlying in zip(labels, *each, strict=True)
        )
        for each in zip(trend.values, trend.sigmas, trend.outlying, strict=True)
    ]
    return [
        f"{num2date(day):%Y-%m-%d %H:%M}: {line}"
        for day, line in zip(trend.days, lines, strict=True)
    ]


def _trend(vehicle: str, sensor: str, rows: Sequence[FleetRow]) -> Trend:
    each = [row.sensor for row in rows if row.sensor is not None]
    marks = [{outlier.parameter[:3] for outlier in row.outliers} for row in rows]
    outlying = np.array(
        [[*(f"t_{axis}" in m for axis in "xyz"), any(p[0] == "H" for p in m)] for m in marks]
    )
    values = np.array([[*(1e3 * v for v in s.t), s.hard_iron] for s in each])
    sigmas = np.array([[*(1e3 * v for v in s.t_sigma), s.hard_iron_sigma] for s in each])
    failed = np.array([s.verdict == "fail" for s in each])
    mean = weighted_mean(values[:, :3], sigmas[:, :3], ~outlying[:, :3])
    values[:, :3] -= mean
    days = [date2num(datetime.strptime(row.date, DATE).replace(tzinfo=UTC)) for row in rows]
    count = sum(bool(row.outliers) for row in rows)
    return Trend(vehicle, sensor, np.array(days), values, sigmas, outlying, failed, count)


def _draw(axes: Axes, trend: Trend, k: int) -> None:
    """Draw one parameter: filled marks, hollow where the verdict is FAIL, rings for outliers."""
    value, sigma = trend.values[:, k], SIGMAS * trend.sigmas[:, k]
    known = np.isfinite(value) & np.isfinite(sigma)
    outlying = known & trend.outlying[:, k]
    usual = known & ~outlying & ~trend.failed
    low, high = _limits(value, sigma, usual if usual.any() else known)
    colour = (*AXES, INK)[k]
    # Those beyond the picture are drawn at its edge.
    shown, days = np.clip(value, low, high), trend.days
    bottom, top = np.clip(value - sigma, low, high), np.clip(value + sigma, low, high)
    across = np.column_stack([days, days, np.full(len(days), np.nan)])[known].ravel()
    along = np.column_stack([bottom, top, np.full(len(days), np.nan)])[known].ravel()
    axes.plot(across, along, "-", color=colour, linewidth=1.2, alpha=0.6)
    good, bad = known & ~trend.failed, known & trend.failed
    dots(axes, days[good], shown[good], 4.5, color=colour, clip_on=False)
    hollow: dict[str, Any] = {"fillstyle": "none", "linestyle": "none", "clip_on": False}
    axes.plot(days[bad], shown[bad], "o", color=colour, markersize=4, **hollow)
    axes.plot(
        days[outlying],
        shown[outlying],
        "o",
        color=BAD,
        markersize=10,
        markeredgewidth=1.6,
        **hollow,
    )
    axes.tick_params(bottom=False, left=False)  # the grid shows them
    axes.set_ylim(low, high)


def _limits(value: FloatArray, sigma: FloatArray, usual: BoolArray) -> tuple[float, float]:
    """Return what is shown: the drives without a fault, with their bars."""
    if not usual.any():
        return -1.0, 1.0
    low, high = float((value - sigma)[usual].min()), float((value + sigma)[usual].max())
    half = ROOM * max(high - low, 1e-6) / 2
    middle = (low + high) / 2
    return middle - half, middle + half

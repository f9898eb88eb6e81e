"""What a sensor read along the drive."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.metric_results import Series
from l2m_gtsam.qa.report.svg import (
    AXES,
    BAD,
    GRID,
    INK,
    MUTED,
    PAPER,
    SMALL,
    X,
    Y,
    dots,
    plain_figure,
)

BETWEEN = 0.04  # of all drives' time, between two drives in a figure


def residuals_figure(series: Series) -> Figure:
    """Draw residuals over time, an axis each, with rejected readings marked."""
    figure = plain_figure(3.8)
    parts = figure.subplots(3, 1, sharex=True, sharey=True)
    seconds, wrong = along(series), np.array(series.rejected)
    residual = np.array(series.residual)
    limit = 1.3 * float(np.quantile(np.abs(residual[~wrong]), 0.995)) if (~wrong).any() else 1.0
    for k, axes in enumerate(parts):
        axes.axhline(0, color=MUTED, linewidth=0.7)
        dots(axes, seconds[~wrong], residual[~wrong, k], 2.2, color=AXES[k], alpha=0.75)
        # Those beyond the picture stand at its edge.
        shown = np.clip(residual[wrong, k], -limit, limit)
        axes.plot(seconds[wrong], shown, "x", color=BAD, markersize=4)
        axes.set_ylabel(f"{'xyz'[k]} (µT)")
    parts[0].set_ylim(-1.05 * limit, 1.05 * limit)
    parts[-1].set_xlabel("time (s)")
    show_drives(parts, series)
    return figure


def curves_figure(course: Series) -> Figure:
    """Draw readings before and after the calibration beside those of the map, an axis each."""
    figure = plain_figure(4.6)
    parts = figure.subplots(3, 1, sharex=True)
    ends = _ends(course)
    seconds = np.insert(along(course), ends, np.nan)
    for k, axes in enumerate(parts):
        before, after, there = (
            np.insert(np.array(each)[:, k], ends, np.nan)
            for each in (course.before, course.after, course.map)
        )
        axes.plot(seconds, before, "-", color=X, linewidth=0.9, label="before (BC)")
        axes.plot(seconds, there, "-", color=INK, linewidth=2.2, alpha=0.35, label="map (MR)")
        axes.plot(seconds, after, "--", color=Y, linewidth=1.0, label="after (AC)")
        axes.set_ylabel(f"{'xyz'[k]} (µT)")
    figure.legend(*parts[0].get_legend_handles_labels(), loc="upper center", ncols=3)
    parts[-1].set_xlabel("time (s)")
    show_drives(parts, course)
    return figure


def along(series: Series) -> FloatArray:
    """Return where readings stand in a figure, shape (N,): drives one after the other."""
    seconds = np.array(series.seconds)
    if series.drive is None:
        return seconds
    return np.asarray(seconds + _starts(series)[np.array(series.drive)])


def show_drives(parts: "np.ndarray", series: Series) -> None:
    """Separate several drives, number them, and give each its own time."""
    if series.drive is None:
        return
    starts, lengths = _starts(series), _lengths(series)
    between = BETWEEN * float(lengths.sum())
    top: Axes = parts[0]
    for k, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        if k > 0:
            for axes in parts:
                axes.axvspan(start - between, start, color=GRID, linewidth=0)
        top.annotate(
            f"drive {k + 1}" if len(starts) <= 4 else str(k + 1),
            (start + length / 2, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -11),
            textcoords="offset points",
            ha="center",
            fontsize=SMALL,
            bbox={"facecolor": PAPER, "edgecolor": "none", "alpha": 0.8, "pad": 1},
        )
    parts[-1].set_xticks(starts + lengths, [f"{each:.0f}" for each in lengths])
    parts[-1].set_xlabel("time (s): the end of each drive, from its own start")


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

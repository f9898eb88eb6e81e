"""What a sensor read along the drive."""

from typing import Protocol

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.metric_results import Series
from l2m_gtsam.qa.report.svg import AXES, BAD, INK, MUTED, X, Y, dots, plain_figure


class WithSeries(Protocol):
    """Figures of a sensor with the course of its drive."""

    @property
    def series(self) -> Series:
        """The course, thinned."""
        ...


def residuals_figure(sensor: WithSeries) -> Figure:
    """Draw residuals over time, an axis each, with rejected readings marked."""
    figure = plain_figure(3.8)
    parts = figure.subplots(3, 1, sharex=True, sharey=True)
    seconds, wrong = np.array(sensor.series.seconds), np.array(sensor.series.rejected)
    residual = np.array(sensor.series.residual)
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
    return figure


def curves_figure(sensor: WithSeries) -> Figure:
    """Draw readings before and after the calibration beside those of the map, an axis each."""
    figure = plain_figure(4.6)
    parts = figure.subplots(3, 1, sharex=True)
    seconds = np.array(sensor.series.seconds)
    course = sensor.series
    for k, axes in enumerate(parts):
        before, after, there = (
            np.array(each)[:, k] for each in (course.before, course.after, course.map)
        )
        axes.plot(seconds, before, "-", color=X, linewidth=0.9, label="before (BC)")
        axes.plot(seconds, there, "-", color=INK, linewidth=2.2, alpha=0.35, label="map (MR)")
        axes.plot(seconds, after, "--", color=Y, linewidth=1.0, label="after (AC)")
        axes.set_ylabel(f"{'xyz'[k]} (µT)")
    figure.legend(*parts[0].get_legend_handles_labels(), loc="upper center", ncols=3)
    parts[-1].set_xlabel("time (s)")
    return figure

"""From which directions the field came, as the lidar sees it."""

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.metric_results import SensorMetrics
from l2m_gtsam.qa.report.svg import GRID, MUTED, X, Y, dots, plain_figure


def equal_area(unit: FloatArray) -> FloatArray:
    """Return directions of one half of space, shape (N, 3), on a disk of radius 1, (N, 2).

    Lambert's azimuthal projection from the nearer pole of z: equal areas stay equal.
    """
    z = np.abs(unit[:, 2])
    r = np.sqrt(np.clip(1 - z, 0, 1))
    flat = np.hypot(unit[:, 0], unit[:, 1])
    scale = np.divide(r, flat, out=np.zeros_like(r), where=flat > 0)
    return np.asarray(unit[:, :2] * scale[:, None])


def directions_figure(sensor: SensorMetrics) -> Figure:
    """Draw the directions on two disks: the upper and the lower half of space."""
    figure = plain_figure(2.7)
    figure.subplots_adjust(left=0.02, right=0.98, bottom=0.03, top=0.86, wspace=0.08)
    b = np.array(sensor.series.map)
    unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    for axes, side, name, colour, size in zip(
        figure.subplots(1, 2), (1, -1), ("upward", "downward"), (X, Y), (2.4, 2.4), strict=True
    ):
        turn = np.linspace(0, 2 * np.pi, 90)
        for elevation in (0, 30, 60):
            r = np.sqrt(1 - np.sin(np.deg2rad(elevation)))
            axes.plot(r * np.cos(turn), r * np.sin(turn), color=GRID, linewidth=0.8)
        axes.plot(np.cos(turn), np.sin(turn), color=MUTED, linewidth=0.9)
        own = unit[np.sign(unit[:, 2]) == side]
        x, y = equal_area(own).T
        dots(axes, x, y, size, color=colour, alpha=0.6)
        axes.set_title(f"{name}: {len(own) / len(unit):.0%}")
        axes.set(aspect="equal", xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
        axes.axis("off")
        axes.annotate("x", (1.02, 0), va="center", color=MUTED)
        axes.annotate("y", (0, 1.02), ha="center", color=MUTED)
    return figure

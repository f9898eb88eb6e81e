"""One sensor on several drives, each calibrated by itself, beside all together."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.qa.report.svg import GRID, INK, MUTED, SMALL, X, new_figure
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.metrics import Repeatability

MANY = 12  # drives beyond which only some are numbered


def drives_figure(sensor: SensorCalibration, found: Repeatability) -> Figure:
    """Draw place and offset by each drive less those of all together, with standard deviations."""
    figure = new_figure(3.6)
    parts = figure.subplots(2, 3, sharex=True, sharey="row")
    whole = np.concatenate([sensor.t_lidar_mag, sensor.distortion.vector()])
    sigma = np.sqrt(np.diag(sensor.covariance))
    for axes_of, first, factor, name, unit in zip(
        parts, (0, 12), (1e3, 1.0), ("t", "H"), ("mm", "µT"), strict=True
    ):
        for k, axes in enumerate(axes_of):
            at = first + k
            values = [(each.estimate[at] - whole[at], each.sigma[at]) for each in found.drives]
            _draw(axes, factor * np.array(values), factor * float(sigma[at]))
            axes.set_title(f"{name}{'xyz'[k]}")
        axes_of[0].set_ylabel(f"off by ({unit})")
    step = max(1, -(-len(found.drives) // MANY))
    numbers = range(0, len(found.drives), step)
    for axes in parts[-1]:
        axes.set_xticks(numbers, [str(k + 1) for k in numbers], fontsize=SMALL)
        axes.set_xlim(-0.6, len(found.drives) - 0.4)
    parts[-1][1].set_xlabel("drive")
    return figure


def _draw(axes: Axes, values: "np.ndarray", sigma: float) -> None:
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


def drive_names(bags: Sequence[str]) -> str:
    """Return which number stands for which drive, in order of time."""
    return ", ".join(f"{k + 1} {bag}" for k, bag in enumerate(bags))

"""The map and the drive through it, and what a sensor's readings leave over it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.metric_results import MapPicture, Metrics, Rows, Series
from l2m_gtsam.qa.report.svg import BAD, PAPER, SMALL, WIDTH, new_figure
from l2m_gtsam.results import Disagreement

# Of colour bars: a drive is wider than high more often than not.
BELOW: Any = {"location": "bottom", "shrink": 0.7, "aspect": 40, "pad": 0.02}


def strength_figure(metrics: Metrics, stretches: Sequence[Disagreement]) -> Figure:
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
    return figure


def sigma_figure(metrics: Metrics) -> Figure:
    """Draw how well the map knows its field along the drive."""
    label = "standard deviation per axis (µT)"
    figure, axes = _map(metrics.map, metrics.map.sigma, label, "cividis")
    _drive(axes, metrics)
    return figure


def residual_figure(series: Series) -> Figure:
    """Draw the length of a sensor's residuals where they were read."""
    place, residual = np.array(series.place), np.array(series.residual)
    wrong = np.array(series.rejected)
    size = np.linalg.norm(residual, axis=1)
    x, y = place[~wrong, :2].T
    figure, axes = wide(np.ptp(place[:, :2], axis=0))
    high = float(np.quantile(size[~wrong], 0.98)) if (~wrong).any() else 1.0
    drawn = axes.scatter(
        x, y, c=size[~wrong], cmap="viridis", vmin=0, vmax=high, s=10, linewidths=0, rasterized=True
    )
    axes.plot(*place[wrong, :2].T, "x", color=BAD, markersize=5, label="rejected")
    figure.colorbar(drawn, ax=axes, label="length of the residual (µT)", **BELOW)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    if wrong.any():
        axes.legend(loc="best")
    return figure


def wide(extent: FloatArray) -> tuple[Figure, Axes]:
    """Return a figure as high as a place of this extent, shape (2,), asks for."""
    height = 0.85 * WIDTH * float(extent[1]) / max(float(extent[0]), 0.1)
    figure = new_figure(float(np.clip(height + 1.3, 2.0, 4.8)))
    return figure, figure.add_subplot()


def strength_background(picture: MapPicture) -> tuple[Figure, Axes]:
    """Draw the field of a map, to draw on."""
    return _map(picture, picture.strength, "field strength (µT)", "viridis")


def _map(picture: MapPicture, values: Rows, label: str, colours: str) -> tuple[Figure, Axes]:
    left, right, bottom, top = picture.extent
    figure, axes = wide(np.array([right - left, top - bottom]))
    image = np.array(values)
    known = image[np.isfinite(image)]
    low, high = np.quantile(known, [0.01, 0.99]) if len(known) else (0.0, 1.0)
    drawn = axes.imshow(
        image, origin="lower", extent=(left, right, bottom, top), cmap=colours, vmin=low, vmax=high
    )
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title(f"at z = {picture.height:.2f} m; blank: no data")
    axes.grid(visible=False)
    figure.colorbar(drawn, ax=axes, label=label, **BELOW)
    return figure, axes


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
    axes.annotate(
        name,
        tuple(place),
        xytext=(6, 6),
        textcoords="offset points",
        fontsize=SMALL,
        color="black",
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1},
    )

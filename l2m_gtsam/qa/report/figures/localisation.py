"""A localised drive: its path over the map, drift of odometry, sigmas and errors of poses."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.metrics.plain import evenly
from l2m_gtsam.qa.metrics.trajectory import HEADING, LocalisedTrajectory
from l2m_gtsam.qa.report.figures.map import mark, strength_background, wide
from l2m_gtsam.qa.report.figures.readings import residual_words
from l2m_gtsam.qa.report.hover import axes_box, axes_places, axes_strips, some
from l2m_gtsam.qa.report.svg import (
    AXES,
    BAD,
    DASHES,
    GOOD,
    GRID,
    INK,
    MUTED,
    SMALL,
    X,
    Y,
    dots,
    ellipse,
    new_figure,
    plain_decades,
    plain_figure,
    short_name,
)
from l2m_gtsam.records.localisation_file import SensorRecord, TruthRecord
from l2m_gtsam.records.metrics import MapPicture
from l2m_gtsam.records.record import Rows

DRAWN = 1500  # poses of a line, at most
ELLIPSES = 12
LARGEST = 0.05  # of the picture's longer side: half an axis of the largest ellipse, at most
SCALES = (1, 2, 5, 10, 20, 50, 100, 200, 500)
BAND_95 = 12.59  # chi-square of six
NAMES_APART = 0.15  # of the picture: nearer names cover each other
ROW = 0.42  # inches of a sensor
DECADE = 10.0
SHORTEST = 1e-4  # m and degrees: less is nothing on an axis of decades


def ellipse_scale(path: LocalisedTrajectory, picture: MapPicture) -> int:
    """Return how many times as large as they are ellipses can be drawn."""
    left, right, bottom, top = picture.extent
    room = LARGEST * max(right - left, top - bottom)
    largest = float(path.sigma[_chosen(path), :2].max())
    fitting = [scale for scale in SCALES if scale * largest <= room]
    return fitting[-1] if fitting else SCALES[0]


def path_figure(path: LocalisedTrajectory, picture: MapPicture, truth: Rows | None) -> Figure:
    """Draw the localised path over the map beside odometry's, with ellipses of one sigma."""
    figure, axes = strength_background(picture)
    keep = evenly(len(path.p), DRAWN)
    _line(axes, path.odometry[keep], "--", color="#ffb000", label="odometry")
    _line(axes, path.p[keep], "-", color="white", label="localised")
    if truth is not None:
        axes.plot(*np.array(truth)[keep, :2].T, ":", color="#ff4fd8", linewidth=1.6, label="truth")
    scale = ellipse_scale(path, picture)
    for k in _chosen(path):
        if not np.isfinite(path.covariance[k, :2, :2]).all():
            continue
        shape = ellipse(path.p[k, :2], path.covariance[k, :2, :2], scale)
        shape.set(facecolor="#ffffff66", edgecolor="black")
        axes.add_patch(shape)
    _mark_ends(axes, path.p[0, :2], path.p[-1, :2], picture)
    rows = some(len(path.p))
    axes_places(axes, path.p[rows, :2], _pose_words(path, rows))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _pose_words(path: LocalisedTrajectory, rows: IntArray) -> list[str]:
    """Return time, place and standard deviations of some poses, a line each."""
    return [
        f"{path.seconds[k]:.1f} s, {path.distance[k]:.1f} m along the path: "
        f"x {path.p[k, 0]:.2f}, y {path.p[k, 1]:.2f} m; sigma {path.position_sigma[k]:.3f} m, "
        f"heading {path.heading_sigma[k]:.2f}°"
        for k in rows
    ]


def _mark_ends(axes: Axes, start: FloatArray, end: FloatArray, picture: MapPicture) -> None:
    """Mark where a path starts and ends: with one name where two would cover each other."""
    left, right, bottom, top = picture.extent
    if np.linalg.norm(end - start) < NAMES_APART * max(right - left, top - bottom):
        axes.plot(*end, "o", color="white", markeredgecolor="black", markersize=6)
        mark(axes, start, "start, end")
        return
    mark(axes, start, "start")
    mark(axes, end, "end")


def drift_figure(path: LocalisedTrajectory) -> Figure:
    """Draw how far odometry alone is from the localised poses along the path."""
    figure = plain_figure(3.2)
    above, below = figure.subplots(2, 1, sharex=True)
    keep = evenly(len(path.distance), DRAWN)
    above.plot(path.distance[keep], path.apart[keep], "-", color=X)
    below.plot(path.distance[keep], path.turned[keep], "-", color=Y)
    above.set(ylabel="distance (m)", ylim=(0, None))
    below.set(ylabel="angle (°)", ylim=(0, None), xlabel="localised path (m)")
    rows = some(len(path.distance))
    words = [
        f"{path.distance[k]:.1f} m: {path.apart[k]:.3f} m, {path.turned[k]:.2f}°" for k in rows
    ]
    for axes in (above, below):
        axes_strips(axes, path.distance[rows], words)
    return figure


def sigma_figure(path: LocalisedTrajectory) -> Figure:
    """Draw standard deviations of poses over time, and those of odometry alone."""
    figure = plain_figure(4.2)
    above, below = figure.subplots(2, 1, sharex=True)
    keep = evenly(len(path.seconds), DRAWN)
    at, own, alone = path.seconds[keep], path.sigma[keep], path.odometry_sigma[keep]
    for k, axis in enumerate("xyz"):
        above.plot(at, own[:, k], DASHES[k], color=AXES[k], label=axis)
    label = "odometry alone"
    above.plot(at, alone[:, :3].max(axis=1), ":", color=MUTED, linewidth=1.6, label=label)
    below.plot(at, own[:, HEADING], "-", color=INK)
    below.plot(at, alone[:, HEADING], ":", color=MUTED, linewidth=1.6)
    above.set_ylabel("position (m)")
    below.set(ylabel="heading (°)", xlabel="time (s)")
    rows = some(len(path.seconds))
    words = _pose_words(path, rows)
    for axes in (above, below):
        _decades(axes)
        axes_strips(axes, path.seconds[rows], words)
    figure.legend(*above.get_legend_handles_labels(), loc="upper center", ncols=4)
    return figure


def truth_figure(path: LocalisedTrajectory, truth: TruthRecord) -> Figure:
    """Draw errors against the truth along the path, and in units of covariances."""
    figure = plain_figure(4.2)
    above, below = figure.subplots(2, 1, sharex=True)
    keep = evenly(len(path.distance), DRAWN)
    distance = path.distance[keep]
    above.plot(distance, np.array(truth.odometry_m)[keep], "--", color=Y, label="odometry")
    above.plot(distance, np.array(truth.localised_m)[keep], "-", color=X, label="localised")
    expected = np.sqrt(np.trace(path.covariance[keep], axis1=1, axis2=2))
    above.plot(distance, expected, ":", color=MUTED, linewidth=1.6, label="stated (1 sigma)")
    above.set(ylabel="error (m)", ylim=(0, None))
    below.axhspan(0, BAND_95, color=GRID, label="95 % if consistent")
    dots(below, distance, np.array(truth.squared)[keep], 2.2, color=X)
    below.set(ylabel="NEES", ylim=(0, None), xlabel="localised path (m)")
    rows = some(len(path.distance))
    words = [
        f"{path.distance[k]:.1f} m: {truth.localised_m[k]:.3f} m, odometry "
        f"{truth.odometry_m[k]:.3f} m; NEES {truth.squared[k]:.1f}"
        for k in rows
    ]
    for axes in (above, below):
        axes_strips(axes, path.distance[rows], words)
    below.legend(loc="best")
    figure.legend(*above.get_legend_handles_labels(), loc="upper center", ncols=3)
    return figure


def counted_figure(sensors: Sequence[SensorRecord]) -> Figure:
    """Draw over time which share of each sensor's readings did not count, a row per sensor."""
    figure = new_figure(1.2 + ROW * len(sensors))
    axes = figure.add_subplot()
    for k, sensor in enumerate(sensors):
        line = sensor.timeline
        counts = np.array([line.used, line.rejected, line.outside], dtype=float)
        whole = np.maximum(counts.sum(axis=0), 1)
        used, wrong, lost = 0.8 * counts / whole
        foot = k + 0.4
        _bars(axes, line.edges, foot, used, color=GOOD, alpha=0.35)
        _bars(axes, line.edges, foot - used, wrong, color=BAD)
        _bars(axes, line.edges, foot - used - wrong, lost, color=MUTED, alpha=0.6)
        for start, end, each in zip(line.edges[:-1], line.edges[1:], counts.T, strict=True):
            words = (
                f"{sensor.use.sensor}, {start:.1f} to {end:.1f} s: {each[0]:.0f} count, "
                f"{each[1]:.0f} rejected, {each[2]:.0f} outside the map"
            )
            axes_box(axes, (start, foot - 0.8), (end - start, 0.8), words, axes.transData)
    for colour, alpha, label in (
        (GOOD, 0.35, "count"),
        (BAD, 1, "rejected"),
        (MUTED, 0.6, "outside the map"),
    ):
        axes.fill_between([], [], [], color=colour, alpha=alpha, linewidth=0, label=label)
    axes.set_yticks(range(len(sensors)), [short_name(each.use.sensor) for each in sensors])
    axes.set(ylim=(len(sensors) - 0.4, -0.6), xlabel="time (s)")
    axes.grid(visible=False, axis="y")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def rejected_figure(path: LocalisedTrajectory, sensors: Sequence[SensorRecord]) -> Figure:
    """Draw where readings were rejected that the map has data for."""
    figure, axes = wide(np.ptp(path.p[:, :2], axis=0))
    keep = evenly(len(path.p), DRAWN)
    axes.plot(*path.p[keep, :2].T, "-", color=MUTED, linewidth=0.9, label="lidar")
    for sensor in sensors:
        if sensor.series is not None:
            wrong = np.array(sensor.series.rejected)
            place = np.array(sensor.series.place)[wrong]
            axes.plot(*place.reshape(-1, 3)[:, :2].T, "x", color=BAD, markersize=4)
            rows = np.flatnonzero(wrong)[some(len(place))]
            seen = np.array(sensor.series.place)[rows, :2].reshape(-1, 2)
            axes_places(axes, seen, residual_words(sensor.series, rows))
    axes.plot([], [], "x", color=BAD, markersize=4, label="rejected readings")
    axes.plot(*path.p[0, :2], "o", color=INK, markersize=5)
    axes.annotate(
        "start", tuple(path.p[0, :2]), xytext=(6, 6), textcoords="offset points", fontsize=SMALL
    )
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.margins(0.08)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def _bars(
    axes: Axes, edges: Sequence[float], foot: FloatArray | float, height: FloatArray, **style: Any
) -> None:
    """Draw bars upwards from a line; values grow downwards on this axis."""
    feet = np.broadcast_to(foot, height.shape)
    steps = np.append(feet, feet[-1]), np.append(feet - height, feet[-1] - height[-1])
    axes.fill_between(edges, *steps, step="post", linewidth=0, **style)


def _line(axes: Axes, p: FloatArray, dashes: str, **style: Any) -> None:
    """Draw a path that is seen on any colour of the map, and beside it in the legend."""
    edge = [Stroke(linewidth=2.8, foreground="black"), Normal()]
    axes.plot(*p[:, :2].T, dashes, linewidth=1.4, path_effects=edge, **style)


def _chosen(path: LocalisedTrajectory) -> FloatArray:
    """Return some poses that are far apart along the path, the last among them."""
    wanted = np.linspace(0, path.distance[-1], ELLIPSES + 1)[1:]
    rows = np.searchsorted(path.distance, wanted)
    return np.unique(np.minimum(rows, len(path.distance) - 1))


def _decades(axes: Axes) -> None:
    """Count upwards in decades; within less than one a plain axis is easier to read."""
    low, high = axes.dataLim.intervaly
    if not low * DECADE < high:
        axes.set_ylim(0, None)
        return
    axes.set_yscale("log", nonpositive="clip")
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, SHORTEST), high)
    plain_decades(axes.yaxis, high > 50 * low)

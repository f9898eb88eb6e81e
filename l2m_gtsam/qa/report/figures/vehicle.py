"""Where the sensors sit on the vehicle, with their ellipses: in the report, and as one picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from l2m_gtsam.data import FloatArray, KnownSensor, Trajectory
from l2m_gtsam.qa.report.figures.map import draw_map
from l2m_gtsam.qa.report.figures.names import OFFSETS, Label, placed
from l2m_gtsam.qa.report.hover import axes_places
from l2m_gtsam.qa.report.svg import (
    BAD,
    FAIR,
    GOOD,
    INK,
    MUTED,
    SMALL,
    ellipse,
    lay_out,
    new_figure,
)
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.metrics import MapPicture
from l2m_gtsam.records.verdict import Level, Verdict
from l2m_gtsam.text import shown, with_sigma

SIGMAS_95 = 5.991**0.5  # half axes that hold 95 %: root of the quantile of chi-square of two
ESTIMATE, TRUTH = "#d55e00", "black"  # vermilion and black differ for all kinds of colour vision
DRIVES = (ESTIMATE, "#cc79a7", "black", "#56b4e9")  # of as many drives as a legend has room for
LONGEST = 40  # letters of a drive's name
COLOURS = {Level.PASS: GOOD, Level.WARN: FAIR, Level.FAIL: BAD}
SHAPES = {Level.PASS: "o", Level.WARN: "^", Level.FAIL: "X"}
# An ellipse that is less than this share of the picture is a dot: all are drawn larger then.
SEEN = 0.1
MARGIN = 0.2  # around all places, of what they span
INSIDE = 3.0  # points between a name and the frame
ENLARGED = (1, 2, 5, 10, 20, 50, 100, 200)


@dataclass(frozen=True)
class Viewpoint:
    """A direction to look from: the axes that it shows, and its name."""

    axes: tuple[int, int]
    name: str


TOP, SIDE = Viewpoint((0, 1), "from above"), Viewpoint((0, 2), "from the side")


def vehicle_figure(result: CalibrationResult, verdict: Verdict, view: Viewpoint) -> Figure:
    """Draw the sensors that were found around the lidar."""
    figure = new_figure(3.6)
    axes = figure.add_subplot()
    found = [each for each in result.sensors if np.isfinite(each.t_lidar_mag).all()]
    factor = enlargement(found, view)
    for sensor in found:
        _draw(axes, sensor, verdict[sensor.sensor].level, view, factor)
    axes.plot(0, 0, "s", color=INK, markersize=9, markerfacecolor="none")
    names = ["xyz"[k] for k in view.axes]
    axes.set(xlabel=f"{names[0]} (m), forward", ylabel=f"{names[1]} (m)")
    axes.set_title(f"95 % ellipses{_drawn(factor)}")
    axes.locator_params(nbins=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.18)
    lay_out(figure)  # names are written where there is room
    _name(axes, found, view)
    for sensor in found:
        at = sensor.t_lidar_mag[list(view.axes)]
        axes_places(axes, at[None], [place_words(sensor, verdict)])
    return figure


def place_words(sensor: SensorCalibration, verdict: Verdict) -> str:
    """Return a sensor's name, verdict and place with standard deviations."""
    parts = [
        f"{axis} {with_sigma(1e3 * value, 1e3 * sigma, 'mm')}"
        for axis, value, sigma in zip("xyz", sensor.t_lidar_mag, sensor.t_sigma, strict=True)
    ]
    return f"{sensor.sensor}, {verdict[sensor.sensor].level.upper()}: {', '.join(parts)}"


def enlargement(found: list[SensorCalibration], view: Viewpoint) -> int:
    """Return how many times larger than they are ellipses have to be drawn to be seen."""
    rows = list(view.axes)
    sizes = np.array([each.t_sigma[rows] for each in found]).ravel()
    sizes = sizes[np.isfinite(sizes)]
    if not len(sizes):
        return 1
    span = float(np.ptp(_places(found, view), axis=0).max())
    wanted = SEEN * span / (2 * SIGMAS_95 * float(np.median(sizes)))
    return max([each for each in ENLARGED if each <= max(wanted, 1)])


def _places(found: list[SensorCalibration], view: Viewpoint) -> FloatArray:
    """Return places of lidar and sensors in a view, with room around a single one, (N, 2)."""
    room = np.array([[0.0, 0.0], [0.1, 0.1], [-0.1, -0.1]])
    own = [each.t_lidar_mag[list(view.axes)] for each in found]
    return np.vstack([room, *own])


def _name(axes: Axes, found: list[SensorCalibration], view: Viewpoint) -> None:
    """Write names of sensors and of the lidar into axes that are where they will be."""
    axes.apply_aspect()
    points = 72.0 / axes.figure.dpi  # in a pixel
    frame = points * axes.bbox.get_points() + [[INSIDE], [-INSIDE]]
    places = np.vstack([np.zeros(2), *(s.t_lidar_mag[list(view.axes)] for s in found)])
    dots = points * axes.transData.transform(places)
    names = ["lidar", *(each.sensor for each in found)]
    labels = [Label(at, (name,), OFFSETS[0]) for at, name in zip(dots, names, strict=True)]
    for label in placed(labels, dots, frame):
        axes.annotate(
            "\n".join(label.lines),
            tuple(axes.transData.inverted().transform(label.at / points)),
            xytext=tuple(label.offset),
            textcoords="offset points",
            ha=("right", "center", "left")[label.side[0] + 1],
            va=("top", "center", "bottom")[label.side[1] + 1],
            fontsize=SMALL,
            arrowprops={"arrowstyle": "-", "color": MUTED, "linewidth": 0.6, "shrinkA": 0},
        )


def _drawn(factor: int) -> str:
    return "" if factor == 1 else f", drawn {factor} times larger"


def _draw(
    axes: Axes, sensor: SensorCalibration, level: Level, view: Viewpoint, factor: int
) -> None:
    rows = list(view.axes)
    at = sensor.t_lidar_mag[rows]
    shape = _ellipse(sensor, rows, factor)
    if shape is None:
        _draw_open(axes, sensor, view)
    else:
        colour = COLOURS[level]
        # The line lies above the marker: an ellipse that is smaller is seen on it.
        shape.set(facecolor="none", edgecolor=colour, linewidth=1.4, zorder=3)
        axes.add_patch(shape)
    axes.plot(*at, SHAPES[level], color=COLOURS[level], markersize=3.5, zorder=2)


def _draw_open(axes: Axes, sensor: SensorCalibration, view: Viewpoint) -> None:
    """Draw a line along each axis in which the place is not known."""
    open_ = ~np.isfinite(sensor.t_sigma)
    for k, axis in enumerate(view.axes):
        if open_[axis]:
            step = np.zeros(2)
            step[k] = 0.3
            low, high = sensor.t_lidar_mag[list(view.axes)] + np.array([-step, step])
            axes.plot(*zip(low, high, strict=True), ":", color=BAD, linewidth=1.5)


def _ellipse(sensor: SensorCalibration, rows: list[int], factor: float = 1.0) -> Ellipse | None:
    """Return the region that holds a sensor in 95 % of cases; none where it is unbounded."""
    covariance = sensor.covariance[np.ix_(rows, rows)]
    if not np.isfinite(covariance).all():
        return None
    return ellipse(sensor.t_lidar_mag[rows], covariance, factor * SIGMAS_95)


def calibration_figure(
    picture: MapPicture,
    drives: Sequence[Trajectory],
    result: CalibrationResult,
    truth: tuple[KnownSensor, ...],
) -> Figure:
    """Draw the map around the drive, and the sensors on the vehicle from above and from the side.

    Parameters
    ----------
    picture
        The map around the drive.
    drives
        Poses of the lidar in the map, drive by drive.
    result
        The calibration; sensors that were not solved are left out.
    truth
        True sensors, where they are known.
    """
    figure = Figure(figsize=(13, 6.5), layout="constrained", dpi=130)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1), height_ratios=(1.5, 1))
    place, above = figure.add_subplot(grid[:, 0]), figure.add_subplot(grid[0, 1])
    side = figure.add_subplot(grid[1, 1])
    strength, label = np.array(picture.strength), "field strength (uT)"
    draw_map(figure, place, strength, picture.extent, label, "viridis", shrink=0.8)
    place.set_facecolor("0.93")
    labels = _drive_labels([Path(each.path).name for each in result.bags], len(drives))
    for k, (drive, name) in enumerate(zip(drives, labels, strict=True)):
        colour = DRIVES[k % len(DRIVES)]
        place.plot(*drive.p[:, :2].T, color="white", linewidth=2.2)
        place.plot(*drive.p[:, :2].T, color=colour, linewidth=1.0, label=name)
    place.set_title(f"map at z = {picture.height:.2f} m", loc="right")
    known = place.legend(loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False, fontsize="small")
    for words in known.get_texts():
        words.set_parse_math(False)  # the figure is laid out with names of files in it
    solved = [s for s in result.sensors if s.residuals is not None]
    factor = enlargement(solved, TOP)
    _draw_vehicle(above, solved, truth, TOP, factor)
    _draw_vehicle(side, solved, truth, SIDE, factor)
    above.set_title("sensors on the vehicle, from above")
    side.set_title("from the side")
    above.legend(loc="lower left", bbox_to_anchor=(0, 1.08), ncols=2, fontsize="small")
    lay_out(figure)
    for axes, view in ((above, TOP), (side, SIDE)):
        _name(axes, solved, view)
    return figure


def _drive_labels(names: Sequence[str], count: int) -> list[str]:
    """Return what the legend calls each drive; with too many for it all have one entry."""
    if count == 1:
        return ["drive of the lidar"]
    if len(names) != count or count > len(DRIVES):
        return ["drives of the lidar", *["_"] * (count - 1)]
    return [f"drive {k}: {shown(name, LONGEST)}" for k, name in enumerate(names, start=1)]


def _draw_vehicle(
    axes: Axes,
    sensors: list[SensorCalibration],
    truth: tuple[KnownSensor, ...],
    view: Viewpoint,
    factor: int,
) -> None:
    names, rows = "xyz", list(view.axes)
    for known in truth:
        axes.plot(*known.t_lidar_mag[rows], "+", color=TRUTH, markersize=10)
    for sensor in sensors:
        at = sensor.t_lidar_mag[rows]
        axes.plot(*at, ".", color=ESTIMATE, markersize=5)
        if (region := _ellipse(sensor, rows, factor)) is not None:
            region.set(facecolor="none", edgecolor=ESTIMATE, linewidth=1.4, zorder=3)
            axes.add_patch(region)
    axes.plot(0, 0, "s", color="0.4", markersize=8)
    axes.plot([], [], ".", color=ESTIMATE, label=f"estimate, 95 % ellipse{_drawn(factor)}")
    if truth:
        axes.plot([], [], "+", color=TRUTH, label="truth")
    axes.set(xlabel=f"{names[rows[0]]} (m)", ylabel=f"{names[rows[1]]} (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(MARGIN)
    axes.grid(alpha=0.3)

"""Where the sensors sit on the vehicle, with their ellipses."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.judge import Verdict
from l2m_gtsam.qa.reasons.reason import Level
from l2m_gtsam.qa.report.svg import BAD, FAIR, GOOD, INK, MUTED, SMALL, new_figure, short_name
from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration

CHI2_95 = 5.991  # of two degrees of freedom
COLOURS = {Level.PASS: GOOD, Level.WARN: FAIR, Level.FAIL: BAD}
SHAPES = {Level.PASS: "o", Level.WARN: "^", Level.FAIL: "X"}
# An ellipse that is less than this share of the picture is a dot: all are drawn larger then.
SEEN = 0.06
BEHIND = 0.08  # of the picture: names closer than this would cover each other
FAR = 0.75  # of the picture: names beyond this stand on the left of their dot
ENLARGED = (1, 2, 5, 10, 20, 50, 100, 200)


@dataclass(frozen=True)
class View:
    """A direction to look from: the axes that it shows, and its name."""

    axes: tuple[int, int]
    name: str


TOP, SIDE = View((0, 1), "from above"), View((0, 2), "from the side")


def vehicle_figure(result: CalibrationResult, verdict: Verdict, view: View) -> Figure:
    """Draw the sensors that were found around the lidar."""
    figure = new_figure(3.6)
    axes = figure.add_subplot()
    found = [each for each in result.sensors if np.isfinite(each.t_lidar_mag).all()]
    factor = enlargement(found, view)
    for sensor in found:
        _draw(axes, sensor, verdict[sensor.sensor].level, view, factor)
    _name(axes, found, view)
    axes.plot(0, 0, "s", color=INK, markersize=9, markerfacecolor="none")
    axes.annotate("lidar", (0, 0), xytext=(-14, -13), textcoords="offset points", color=MUTED)
    names = ["xyz"[k] for k in view.axes]
    axes.set(xlabel=f"{names[0]} (m), forward", ylabel=f"{names[1]} (m)")
    axes.set_title(f"95 % ellipses{_drawn(factor)}")
    axes.locator_params(nbins=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.18)
    return figure


def enlargement(found: list[SensorCalibration], view: View) -> int:
    """Return how many times larger than they are ellipses have to be drawn to be seen."""
    rows = list(view.axes)
    sizes = np.array([each.t_sigma[rows] for each in found]).ravel()
    sizes = sizes[np.isfinite(sizes)]
    if not len(sizes):
        return 1
    span = float(np.ptp(_places(found, view), axis=0).max())
    wanted = SEEN * span / (2 * np.sqrt(CHI2_95) * float(np.median(sizes)))
    return max([each for each in ENLARGED if each <= max(wanted, 1)])


def _places(found: list[SensorCalibration], view: View) -> FloatArray:
    """Return places of lidar and sensors in a view, with room around a single one, (N, 2)."""
    room = np.array([[0.0, 0.0], [0.1, 0.1], [-0.1, -0.1]])
    own = [each.t_lidar_mag[list(view.axes)] for each in found]
    return np.vstack([room, *own])


def _name(axes: Axes, found: list[SensorCalibration], view: View) -> None:
    """Write names; sensors that lie behind each other in this view share a label."""
    near = BEHIND * float(np.ptp(_places(found, view), axis=0).max())
    labels: list[tuple[FloatArray, list[str]]] = []
    for sensor in found:
        at = sensor.t_lidar_mag[list(view.axes)]
        there = next((names for place, names in labels if np.abs(place - at).max() < near), None)
        if there is None:
            labels.append((at, [sensor.sensor]))
        else:
            there.append(sensor.sensor)
    x = _places(found, view)[:, 0]
    far = x.min() + FAR * np.ptp(x)
    for at, names in labels:
        text = "\n".join(map(short_name, names))
        right = at[0] > far
        label = axes.annotate(
            text,
            tuple(at),
            xytext=(-7 if right else 7, 4),
            textcoords="offset points",
            ha="right" if right else "left",
            fontsize=SMALL,
        )
        label.set_in_layout(False)  # a long name is no reason to draw the vehicle smaller


def _drawn(factor: int) -> str:
    return "" if factor == 1 else f", drawn {factor} times larger"


def _draw(axes: Axes, sensor: SensorCalibration, level: Level, view: View, factor: int) -> None:
    rows = list(view.axes)
    at = sensor.t_lidar_mag[rows]
    shape = ellipse(at, sensor.covariance[np.ix_(rows, rows)] * factor**2)
    if shape is None:
        _draw_open(axes, sensor, view)
    else:
        shape.set(facecolor=COLOURS[level], edgecolor=COLOURS[level], alpha=0.35)
        axes.add_patch(shape)
    axes.plot(*at, SHAPES[level], color=COLOURS[level], markersize=5)


def _draw_open(axes: Axes, sensor: SensorCalibration, view: View) -> None:
    """Draw a line along each axis in which the place is not known."""
    open_ = ~np.isfinite(sensor.t_sigma)
    for k, axis in enumerate(view.axes):
        if open_[axis]:
            step = np.zeros(2)
            step[k] = 0.3
            low, high = sensor.t_lidar_mag[list(view.axes)] + np.array([-step, step])
            axes.plot(*zip(low, high, strict=True), ":", color=BAD, linewidth=1.5)


def ellipse(at: FloatArray, covariance: FloatArray) -> Ellipse | None:
    """Return the region that holds a sensor in 95 % of cases; none where it is unbounded."""
    if not np.isfinite(covariance).all():
        return None
    variances, directions = np.linalg.eigh(covariance)
    width, height = 2 * np.sqrt(CHI2_95 * np.maximum(variances, 0))
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    return Ellipse((float(at[0]), float(at[1])), width, height, angle=angle)

"""The scaling study's curves as a picture."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.scaling.measurements import Part, Way
from l2m_gtsam.studies.scaling.table import Curve, ScalingTable

# Okabe and Ito's colours differ for all kinds of colour vision; peers are grey.
STYLES = {
    Way.POINT: ("#56b4e9", "o"),
    Way.FULL: ("#0072b2", "s"),
    Way.NUMERIC: ("0.5", "^"),
    Way.HARMONIC: ("#0072b2", "o"),
    Way.SLIDING: ("#d55e00", "s"),
    Way.DENSE: ("0.5", "^"),
    Way.BATCH: ("#0072b2", "o"),
    Way.STARTED: ("#56b4e9", "s"),
}
LABELS = {
    Part.READINGS: "readings of one sensor",
    Part.SENSORS: "sensors",
    Part.SURVEY: "readings of the survey",
    Part.WORKERS: "workers",
}
TITLES = {
    Part.READINGS: "a calibration",
    Part.SENSORS: "a calibration of several",
    Part.SURVEY: "a map",
    Part.WORKERS: "a batch of calibrations",
}
ROOM = 1.6  # beside the first and last size


def scaling_figure(table: ScalingTable) -> Figure:
    """Draw time against each quantity, both logarithmic."""
    figure = Figure(figsize=(9.5, 8), layout="constrained", dpi=150)
    grid = figure.subplots(2, 2)
    for axes, part in zip(grid.flat, Part, strict=True):
        curves = [each for each in table.curves if each.part is part]
        if not curves:
            axes.set_axis_off()
            continue
        for curve in curves:
            draw(axes, curve)
        if part is Part.WORKERS:
            draw_ideal(axes, curves[0])
        finish(axes, part, curves)
    return figure


def draw(axes: Axes, curve: Curve) -> None:
    """Draw one curve, with its exponent in its label."""
    colour, marker = STYLES[curve.way]
    size, seconds = points(curve)
    label = str(curve.way)
    if curve.exponent is not None and curve.part is not Part.WORKERS:
        label += f" (exponent {curve.exponent:.1f})"
    axes.plot(size, seconds, color=colour, marker=marker, markersize=5, linewidth=1.4, label=label)


def draw_ideal(axes: Axes, curve: Curve) -> None:
    """Draw what a batch would take if each worker had a core to itself."""
    size, seconds = points(curve)
    axes.plot(size, seconds[0] * size[0] / size, ":", color="0.3", label="in proportion")


def points(curve: Curve) -> tuple[FloatArray, FloatArray]:
    """Return sizes and seconds of a curve."""
    size = np.array([each.size for each in curve.points], dtype=np.float64)
    return size, np.array([each.seconds for each in curve.points])


def finish(axes: Axes, part: Part, curves: list[Curve]) -> None:
    """Set scales, ticks at the measured sizes, and words."""
    sizes = sorted({each.size for curve in curves for each in curve.points})
    axes.set(xscale="log", yscale="log", xlabel=LABELS[part], title=TITLES[part])
    seconds = "seconds" if part is Part.WORKERS else "seconds of one core"
    axes.set_ylabel(seconds)
    axes.set_xlim(sizes[0] / ROOM, sizes[-1] * ROOM)
    axes.set_xticks(sizes, [short(size) for size in sizes])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(axis="x", which="minor", bottom=False)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def short(size: int) -> str:
    """Return a size in few letters: 16k for 16,000."""
    return f"{size / 1000:g}k" if size >= 1000 else str(size)

"""The scaling study: ``l2m study scaling``."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from l2m_gtsam.data import FloatArray
from l2m_gtsam.studies.scaling.measurements import (
    Curve,
    Measurement,
    Quantity,
    ScalingCell,
    ScalingOptions,
    ScalingTable,
    TimedTask,
    scaling_table,
)
from l2m_gtsam.studies.scaling.tasks import (
    MappedDrive,
    mapped_drive,
    measured_map,
    measured_solves,
    warmed,
)
from l2m_gtsam.studies.scaling.workers import measured_workers
from l2m_gtsam.studies.site import SurveyedSite, surveyed
from l2m_gtsam.studies.study import Study, table

# Okabe and Ito's colours differ for all kinds of colour vision; peers are grey.
STYLES = {
    TimedTask.POINT: ("#56b4e9", "o"),
    TimedTask.FULL: ("#0072b2", "s"),
    TimedTask.NUMERIC: ("0.5", "^"),
    TimedTask.HARMONIC: ("#0072b2", "o"),
    TimedTask.SLIDING: ("#d55e00", "s"),
    TimedTask.DENSE: ("0.5", "^"),
    TimedTask.BATCH: ("#0072b2", "o"),
    TimedTask.STARTED: ("#56b4e9", "s"),
}
# Of an axis, of a panel, and of a part of the page.
TITLES = {
    Quantity.READINGS: ("readings of one sensor", "a calibration", "Readings"),
    Quantity.SENSORS: ("sensors", "a calibration of several", "Sensors"),
    Quantity.SURVEY: ("readings of the survey", "a map", "Size of the map"),
    Quantity.WORKERS: ("workers", "a batch of calibrations", "Workers"),
}
ROOM = 1.6  # beside the first and last size


class ScalingStudy(Study[ScalingOptions, ScalingCell, ScalingTable]):
    """Time and memory over size; a cell is one size of one quantity."""

    name = "scaling"
    title = "How time grows"
    size = frozenset({"readings", "survey", "dense", "workers"})

    def keys(self, options: ScalingOptions) -> tuple[str, ...]:
        """Return a cell for each size of each quantity, workers last: quantity, task, size."""
        maps = {
            TimedTask.HARMONIC: options.survey,
            TimedTask.SLIDING: options.survey,
            TimedTask.DENSE: options.dense,
        }
        return (
            *(f"{Quantity.READINGS}-{size:05d}" for size in options.readings),
            *(f"{Quantity.SENSORS}-{size:02d}" for size in options.sensors),
            *(
                f"{Quantity.SURVEY}-{task.name.lower()}-{size:05d}"
                for task, sizes in maps.items()
                for size in sizes
            ),
            *(f"{Quantity.WORKERS}-{count:02d}" for count in options.workers),
        )

    def site(self, options: ScalingOptions, key: str) -> str:
        """Return the quantity: all its cells share a map or a survey."""
        return key.partition("-")[0]

    def prepare(self, options: ScalingOptions, site: str) -> SurveyedSite | MappedDrive | None:
        """Return what the cells of a quantity share."""
        match Quantity(site):
            case Quantity.READINGS:
                return warmed(options, mapped_drive(options, hall(options), 1, options.rate))
            case Quantity.SENSORS:
                rate = options.site.scenario.calibration_sampling.field_rate
                work = mapped_drive(options, hall(options), max(options.sensors), rate)
                return warmed(options, work)
            case Quantity.SURVEY:
                return hall(options)
            case Quantity.WORKERS:
                return None

    def compute(self, options: ScalingOptions, key: str, shared: Any) -> ScalingCell:
        """Measure one size."""
        quantity, *task, size = key.split("-")
        count = int(size)
        match Quantity(quantity):
            case Quantity.READINGS as grown:
                numeric = count <= options.numeric_readings
                work = shared.thinned(count)
                measured = measured_solves(options, grown, len(work.readings), work, numeric)
            case Quantity.SENSORS as grown:
                numeric = count <= options.numeric_sensors
                work = shared.first(count).thinned(options.each)
                measured = measured_solves(options, grown, len(work.t_true), work, numeric)
            case Quantity.SURVEY:
                measured = (measured_map(options, TimedTask[task[0].upper()], count, shared),)
            case Quantity.WORKERS:
                measured = measured_workers(options, count)
        return ScalingCell(measured)

    def summarise(self, options: ScalingOptions, cells: Mapping[str, ScalingCell]) -> ScalingTable:
        """Join all measurements."""
        return scaling_table(options, [one for cell in cells.values() for one in cell.measurements])

    def page_context(self, summary: ScalingTable) -> dict[str, Any]:
        """Return the curves of each quantity that was measured, and their tables."""
        parts = ((part, [c for c in summary.curves if c.part is part]) for part in Quantity)
        return {
            "parts": [(part, curves) for part, curves in parts if curves],
            "titles": TITLES,
            "time_table": time_table,
            "has_memory": lambda curves: any(
                p.peak_mib is not None for c in curves for p in c.points
            ),
            "memory_table": memory_table,
        }

    def figures(self, summary: ScalingTable) -> dict[str, Figure]:
        """Draw time against each quantity, both logarithmic."""
        figure = Figure(figsize=(9.5, 8), layout="constrained", dpi=150)
        grid = figure.subplots(2, 2)
        for axes, part in zip(grid.flat, Quantity, strict=True):
            curves = [each for each in summary.curves if each.part is part]
            if not curves:
                axes.set_axis_off()
                continue
            for curve in curves:
                draw(axes, curve)
            if part is Quantity.WORKERS:
                draw_ideal(axes, curves[0])
            finish(axes, part, curves)
        return {"scaling": figure}


@lru_cache(maxsize=1)
def hall(options: ScalingOptions) -> SurveyedSite:
    """Return world and survey; made once in each process."""
    return surveyed(options.site)


def time_table(curves: Sequence[Curve]) -> str:
    """Return the times of one quantity: a row for each size, and the exponents."""
    rows = size_rows(curves, lambda point: f"{point.seconds:.3g}")
    if curves[0].part is not Quantity.WORKERS:
        slopes = ("-" if c.exponent is None else f"{c.exponent:.2f}" for c in curves)
        rows.append(["exponent", *slopes])
    return table([str(curves[0].part), *(f"{curve.way} (s)" for curve in curves)], rows)


def memory_table(curves: Sequence[Curve]) -> str:
    """Return the peaks of memory of one quantity: a row for each size."""
    rows = size_rows(curves, lambda p: "-" if p.peak_mib is None else f"{p.peak_mib:,.0f}")
    return table([str(curves[0].part), *(f"{curve.way} (MiB)" for curve in curves)], rows)


def size_rows(curves: Sequence[Curve], text: Callable[[Measurement], str]) -> list[list[str]]:
    """Return a row of cells for each size, ascending; a dash where nothing was measured."""
    found = [{point.size: text(point) for point in curve.points} for curve in curves]
    sizes = sorted({size for each in found for size in each})
    return [[f"{size:,}", *(each.get(size, "-") for each in found)] for size in sizes]


def draw(axes: Axes, curve: Curve) -> None:
    """Draw one curve, with its exponent in its label."""
    colour, marker = STYLES[curve.way]
    size, seconds = points(curve)
    label = str(curve.way)
    if curve.exponent is not None and curve.part is not Quantity.WORKERS:
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


def finish(axes: Axes, part: Quantity, curves: list[Curve]) -> None:
    """Set scales, ticks at the measured sizes, and words."""
    sizes = sorted({each.size for curve in curves for each in curve.points})
    label, title, _ = TITLES[part]
    axes.set(xscale="log", yscale="log", xlabel=label, title=title)
    seconds = "seconds" if part is Quantity.WORKERS else "seconds of one core"
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


SCALING = ScalingStudy()

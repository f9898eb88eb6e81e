"""The scaling study as a page of Markdown."""

from collections.abc import Callable, Sequence

from l2m_gtsam.studies.markdown import table_lines
from l2m_gtsam.studies.scaling.measurements import Measurement, Part
from l2m_gtsam.studies.scaling.table import Curve, Ratio, ScalingTable

HEADS = {
    Part.READINGS: "Readings",
    Part.SENSORS: "Sensors",
    Part.SURVEY: "Size of the map",
    Part.WORKERS: "Workers",
}


def scaling_page(table: ScalingTable) -> str:
    """Return the page of a study, but for its title."""
    parts = [
        INTRO,
        "![Time against readings, sensors, size of the map and workers](scaling.png)",
        *(text for part in Part for text in section(table, part)),
        speed_lines(table),
    ]
    return "\n\n".join(text for text in parts if text)


INTRO = (
    "Each quantity grows while the others stay as they are. Times are seconds of one core "
    "(processor time), those of workers seconds of the clock; they differ from machine to machine "
    "and, by a tenth or so, from run to run, which growth and ratios hardly do. Cells that are "
    "computed beside each other share memory and caches: for quiet times run the study with "
    "`--workers 1`. The exponent is the slope of log time over log size through the largest three "
    "sizes: 1 is in proportion, 2 quadratic."
)


def section(table: ScalingTable, part: Part) -> list[str]:
    """Return heading, words and table of one quantity; nothing where it was not measured."""
    curves = [each for each in table.curves if each.part is part]
    if not curves:
        return []
    ratios = [each for each in table.ratios if each.part is part]
    said = [about(table, part), time_lines(curves), memory_lines(curves), ratio_words(ratios)]
    return [f"## {HEADS[part]}", *said]


def about(table: ScalingTable, part: Part) -> str:
    """Return what was measured."""
    options = table.options
    peer = (
        "The peer is one least squares over t, C and H of all sensors together with numeric "
        "derivatives, on the same map and from the truth, which spares it the search."
    )
    ours = (
        "Ours includes the search for starts; the map has been used before, for it makes ready "
        "what it is asked for the first time."
    )
    return {
        Part.READINGS: f"One sensor on one drive. {ours} {peer}",
        Part.SENSORS: f"{options.each:,} readings of each sensor, calibrated together. "
        "The peer's work grows with the square of the sensors for its derivatives, and with the "
        "cube for its algebra.",
        Part.SURVEY: "Maps of the survey's readings next to the middle of the hall: the floor "
        "grows, the density stays. Hyperparameters are learnt. The peer is one Gaussian process of "
        "all readings, whose algebra grows with the cube.",
        Part.WORKERS: f"{options.calibrations} drives, each simulated and calibrated (values "
        "only), on local processes of one thread each.",
    }[part]


def time_lines(curves: Sequence[Curve]) -> str:
    """Return the times of one quantity as a table: a row for each size, and the exponents."""
    head = "".join(f"| {curve.way} (s) " for curve in curves)
    rows = rows_of(curves, seconds)
    if curves[0].part is not Part.WORKERS:
        steep = ("-" if c.exponent is None else f"{c.exponent:.2f}" for c in curves)
        rows.append(["exponent", *steep])
    return table_lines(f"| {curves[0].part} {head}|", rows)


def memory_lines(curves: Sequence[Curve]) -> str:
    """Return the memory as a table; nothing where none was measured."""
    if all(each.peak_mib is None for curve in curves for each in curve.points):
        return ""
    head = "".join(f"| {curve.way} (MiB) " for curve in curves)
    lines = table_lines(f"| {curves[0].part} {head}|", rows_of(curves, memory))
    return f"Growth of the process meanwhile:\n\n{lines}"


def rows_of(curves: Sequence[Curve], what: Callable[[Measurement], str]) -> list[list[str]]:
    """Return a row of words for each size, ascending."""
    sizes = sorted({each.size for curve in curves for each in curve.points})
    return [[f"{size:,}", *(of(curve, size, what) for curve in curves)] for size in sizes]


def of(curve: Curve, size: int, what: Callable[[Measurement], str]) -> str:
    """Return what was measured at a size, in words; a dash where nothing was."""
    return next((what(each) for each in curve.points if each.size == size), "-")


def seconds(point: Measurement) -> str:
    """Return a time."""
    return f"{point.seconds:.3g}"


def memory(point: Measurement) -> str:
    """Return a peak of memory."""
    return "-" if point.peak_mib is None else f"{point.peak_mib:,.0f}"


def ratio_words(ratios: Sequence[Ratio]) -> str:
    """Return how much longer the peer takes."""
    return " ".join(
        f"At {each.size:,} the {each.peer} takes {each.times:.2g} times as long as *{each.way}*."
        for each in ratios
    )


def speed_lines(table: ScalingTable) -> str:
    """Return what workers gain; nothing where they were not measured."""
    if not table.speeds:
        return ""
    fewest = table.speeds[0].workers
    head = f"| workers | speed, {fewest} being 1 | with start of the workers |"
    rows = [[str(s.workers), f"{s.times:.2f}", f"{s.started:.2f}"] for s in table.speeds]
    return (
        f"{table_lines(head, rows)}\n\nThe start of the workers, what they prepare (the place is "
        "made by one of them) and the first calibration of each, in which everything happens for "
        "the first time, count only in the last column. More workers than the machine has cores "
        "gain nothing."
    )

"""What commands have in common: arguments, tables, warnings and progress at a terminal."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from l2m_gtsam.text import shown

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from l2m_gtsam.progress import Progress
    from l2m_gtsam.records.verdict import Level, Verdict

STARTING = "starting"
LONGEST_STAGE = 60  # letters
USUAL_WIDTH = 120  # of a file, or of whatever else is no terminal
SPACE = 2  # between columns
FEWEST_COLUMNS = 3  # of a table, on a terminal of any width
ESTIMATE_S = 3600.0  # the time left follows from the pace over so many seconds
LOGS = "ROS1 .bag, ROS2 folder, .db3, .mcap, .csv or .ulg"  # that drives are read from

BagArgument = Annotated[Path, typer.Argument(metavar="BAG", help=f"{LOGS}.")]
PosesOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--poses",
        metavar="FILE",
        help="Poses in a file of their own: TUM, KITTI or .csv; one for each log, in their order.",
    ),
]
PoseTimesOption = Annotated[
    Path | None,
    typer.Option("--pose-times", metavar="FILE", help="Times of KITTI's poses in seconds."),
]
MapOption = Annotated[Path, typer.Option("--map", help="Map file made by `l2m map build`.")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML configuration; see configs/.")
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="Processes; as many as there are cores if not given.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(metavar="TCP://HOST:PORT", help="A running Dask cluster that computes."),
]
CalibrationOption = Annotated[
    Path, typer.Option("--calibration", help="calibration.yaml of `l2m calibrate`.")
]
SensorsOption = Annotated[
    Path,
    typer.Option(
        "--calibration",
        help="calibration.yaml of `l2m calibrate`, or a list of sensors with t, C and H.",
    ),
]


StrictOption = Annotated[
    bool, typer.Option("--strict", help="End with exit code 3 if the verdict is FAIL.")
]
WideOption = Annotated[
    bool, typer.Option("--wide", help="Print all columns of tables, however wide.")
]
FAILED = 3  # exit code of a verdict; 2 is that of an error


def print_verdict(verdict: "Verdict", least: "Level | None" = None) -> None:
    """Print a verdict with its reasons of at least a level, WARN if none is given."""
    from rich.console import Console
    from rich.markup import escape

    from l2m_gtsam.cli.tables import coloured
    from l2m_gtsam.records.verdict import Level

    console = Console(highlight=False)
    for line in map(shown, verdict.lines(least or Level.WARN)):
        text = escape(line)
        for level in Level:
            # The first word in capitals that is a level: reasons may hold it, too.
            if line.lstrip().removeprefix("verdict: ").startswith(level.upper()):
                text = text.replace(level.upper(), coloured(level), 1)
        console.print(text, soft_wrap=True)


def end_with(level: "Level", strict: bool) -> None:
    """End with exit code 3 if a verdict is FAIL and that is asked for."""
    if strict and level == "fail":
        raise typer.Exit(FAILED)


def warn(doubts: Sequence[str]) -> None:
    """Print doubts about a result that was written all the same on the error stream."""
    for doubt in doubts:
        typer.echo(f"l2m: warning: {shown(doubt)}", err=True)


def say(*lines: str) -> None:
    """Print lines; names that others chose are in them."""
    for line in lines:
        typer.echo(shown(line))


def say_written(files: Sequence[Path], report_id: str) -> None:
    """Print which files were written, and in the last line the id of the report on them."""
    from l2m_gtsam.storage.report_id import SHOWN

    say(f"written: {', '.join(map(str, files))}", f"report id: {report_id[:SHOWN]}")


@contextmanager
def shown_notices() -> Iterator[None]:
    """Show notices of this program as its warnings; others appear as Python has them."""
    import warnings

    from l2m_gtsam.errors import Notice

    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *more: Any, **named: Any) -> None:
            if issubclass(category, Notice):
                warn([str(message)])
            else:
                usual(message, category, *more, **named)

        warnings.simplefilter("always", Notice)
        warnings.showwarning = show
        yield


def print_table(table: "Table", wide: bool = False) -> None:
    """Print as many columns of a table as fit, and the names of those that do not.

    Parameters
    ----------
    table
        With its columns in the order of their importance.
    wide
        Whether all columns are printed, on a terminal of any width.
    """
    from rich.console import Console

    _show_control_characters(table)
    console = Console()
    known = console.is_terminal or "COLUMNS" in os.environ
    width = console.width if known else USUAL_WIDTH
    if wide:
        width = max(_needed(console, table), width)
    left_out: list[str] = []
    while len(table.columns) > FEWEST_COLUMNS and _needed(console, table) > width:
        left_out.insert(0, str(table.columns.pop().header))
    _widen(console, table, width - _needed(console, table))
    Console(width=width).print(table)
    if left_out:
        Console(width=width, highlight=False).print(f"--wide shows also: {', '.join(left_out)}")


@contextmanager
def shown_progress() -> "Iterator[Progress]":
    """Show one bar per stage on the error stream while it runs.

    One named "starting" is there from the first until there is a stage: what a command
    needs is best imported inside. Where the stream is no terminal each stage is a line when it
    begins.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeftColumn

    columns = (
        TextColumn("{task.description:<28}", markup=False),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeLeftColumn(),
    )
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _stage_lines()
        return
    with Progress(*columns, console=console, speed_estimate_period=ESTIMATE_S) as bars:
        stages: dict[str, TaskID] = {}
        starting = [bars.add_task(STARTING, total=None)]
        bars.refresh()

        def report(stage: str, fraction: float) -> None:
            if stage not in stages:
                stages[stage] = bars.add_task(shown(stage, LONGEST_STAGE), total=1.0)
            bars.update(stages[stage], completed=fraction)
            while starting:
                bars.remove_task(starting.pop())

        try:
            yield report
        finally:
            while starting:
                bars.remove_task(starting.pop())


def _stage_lines() -> "Progress":
    """Return what writes the name of each stage to the error stream, once."""
    seen: set[str] = set()

    def report(stage: str, _fraction: float) -> None:
        if stage not in seen:
            seen.add(stage)
            typer.echo(shown(stage, LONGEST_STAGE), err=True)

    return report


def _show_control_characters(table: "Table") -> None:
    """Put text in the place of control characters, in headings and cells."""
    for name in ("title", "caption"):
        if isinstance(text := getattr(table, name), str):
            setattr(table, name, shown(text))
    for column in table.columns:
        column._cells = [shown(cell) if isinstance(cell, str) else cell for cell in column.cells]


def _widen(console: "Console", table: "Table", spare: int) -> None:
    """Give room that is left to columns of text, the first ones first.

    Left to itself rich takes it from all of them alike, and may cut off the last column.
    """
    from rich.measure import Measurement

    options = console.options.update(width=1000)
    for column in table.columns:
        if column.min_width is not None:
            cells = (column.header, *column.cells)
            longest = max(Measurement.get(console, options, cell).maximum for cell in cells)
            extra = max(0, min(spare, longest - column.min_width))
            column.width = column.min_width + extra
            spare -= extra


def _needed(console: "Console", table: "Table") -> int:
    """Return the width of a table whose words, and lines that do not wrap, are whole.

    Text that is broken where it must has a least width of its own.
    """
    from rich.measure import Measurement

    options, widths = console.options.update(width=1000), []
    for column in table.columns:
        cells = (Measurement.get(console, options, cell) for cell in (column.header, *column.cells))
        width = max(cell.maximum if column.no_wrap else cell.minimum for cell in cells)
        widths.append(width if column.min_width is None else column.min_width)
    return sum(widths) + SPACE * (len(widths) - 1)

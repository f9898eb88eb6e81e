"""The command line: ``l2m``. Parsing and printing only; the work is done in ``batch``.

Heavy modules are imported inside the commands, so that ``--help`` answers at once, and below the
first bar, so that it stands there while they load.
"""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from l2m_gtsam.cli import exports
from l2m_gtsam.cli.fleet import batch
from l2m_gtsam.cli.report import report
from l2m_gtsam.cli.slam import slam
from l2m_gtsam.cli.study import study
from l2m_gtsam.cli.suite import suite
from l2m_gtsam.cli.terminal import print_table, shown_notices, shown_progress, warn
from l2m_gtsam.cli.validate import validate
from l2m_gtsam.errors import L2MError

if TYPE_CHECKING:
    from l2m_gtsam.records.calibration import CalibrationResult
    from l2m_gtsam.simulate.scenario import ScenarioOptions

app = typer.Typer(
    name="l2m",
    help="Calibrate magnetometers against a LiDAR from one drive through a mapped field.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
map_app = typer.Typer(
    help="Build, update, compare, describe and draw magnetic maps; calibrate a mapping suite.",
    no_args_is_help=True,
)
app.add_typer(map_app, name="map")
app.command()(study)
app.command()(batch)
exports.register(app)
app.command()(report)
app.command()(validate)
app.command()(slam)
map_app.command("suite")(suite)

BagArgument = Annotated[
    Path, typer.Argument(metavar="BAG", help="ROS1 .bag, ROS2 folder, .db3 or .mcap.")
]
MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="Map file.")]
MapOption = Annotated[Path, typer.Option("--map", help="Map file made by `l2m map build`.")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="YAML configuration; see configs/.")
]
BagsArgument = Annotated[list[Path], typer.Argument(metavar="BAG...", help="Mapping bags.")]
SuiteOption = Annotated[
    Path | None,
    typer.Option("--suite", help="Calibrations of the mapping suite; ideal sensors if not given."),
]
StructureOption = Annotated[
    str | None,
    typer.Option(
        "--structure",
        metavar="CLOUD",
        help="What the LiDAR saw: .pcd, .ply or .npz in the map frame, or a PointCloud2 topic.",
    ),
]
ScenarioOption = Annotated[
    Path | None, typer.Option("--options", help="YAML with the options of the simulation.")
]
TilesOption = Annotated[
    bool,
    typer.Option(
        help="Make all tiles of the map now and keep them in the folder MAP.tiles beside it; else "
        "each is made, and kept, when it is first needed."
    ),
]
SeedOption = Annotated[
    int | None,
    typer.Option(min=0, help="Of world, drives and sensors, instead of that in --options (1)."),
]
MapFileOption = Annotated[Path, typer.Option("--out", help="Map file to write (.npz).")]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results.")]


def main() -> None:
    """Run the command line; an error that a user can mend is one line and exit code 2."""
    # Blocks of a few hundred readings are too small for threads, which then only wait for each
    # other; has to be said before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    try:
        with shown_notices():
            app(arguments)
    except L2MError as error:
        if "--debug" in sys.argv[1:]:
            raise
        typer.echo(f"l2m: {error}", err=True)
        sys.exit(2)


def _version(wanted: bool) -> None:
    """Print the version and end."""
    if wanted:
        from importlib.metadata import version

        typer.echo(f"l2m {version('l2m-gtsam')}")
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Show the version."),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error (at any place).")
    ] = False,
) -> None:
    """Calibrate magnetometers against a LiDAR from one drive through a mapped field."""


@app.command()
def inspect(bag: BagArgument, config: ConfigOption = None) -> None:
    """Say what is in a bag and what would be used of it, and why."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import inspect_file
        from l2m_gtsam.cli.tables.tables import bag_table
        from l2m_gtsam.config import load_config

        report = inspect_file(bag, load_config(config), progress)
    print_table(bag_table(report))
    for obstacle in report.obstacles:
        typer.echo(f"cannot be calibrated as it is: {obstacle}")
    typer.echo("clock: record time less header stamp, median; |B|: lowest - median - highest")


@app.command()
def simulate(
    out: OutOption,
    options: ScenarioOption = None,
    seed: SeedOption = None,
    kind: Annotated[
        list[str] | None, typer.Option(help="ros1, sqlite3 or mcap; all three if not given.")
    ] = None,
) -> None:
    """Simulate a warehouse, a mapping drive and a calibration drive, and write them as bags."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.simulation import simulate_bags
        from l2m_gtsam.errors import ConfigError
        from l2m_gtsam.simulate.bag_writer import BagKind

        known = [each.value for each in BagKind]
        if unknown := [each for each in kind or [] if each not in known]:
            msg = f"--kind: unknown bag kind {unknown[0]!r}; accepted: {', '.join(known)}"
            raise ConfigError(msg)
        wanted = _scenario(options, seed)
        simulate_bags(out, wanted, [BagKind(k) for k in kind or known], progress)
    typer.echo(f"bags, suite.yaml, structure.ply and truth.yaml are in {out}")


@app.command()
def calibrate(
    map_path: MapOption,
    out: OutOption,
    bags: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="BAG...",
            help="ROS1 .bag, ROS2 folder, .db3 or .mcap; several of one vehicle are calibrated "
            "together and compared.",
        ),
    ] = None,
    more: Annotated[
        list[Path] | None, typer.Option("--bag", metavar="BAG", help="The same; may be repeated.")
    ] = None,
    config: ConfigOption = None,
    uncertainty: Annotated[
        str | None,
        typer.Option(
            help="full (default, unless the configuration says otherwise): readings near each "
            "other share the map's errors; independent: each has its own, which gives sigmas that "
            "are too small. Kinds of map that do not know how their errors are correlated always "
            "use independent."
        ),
    ] = None,
    models: Annotated[
        bool, typer.Option("--models", help="Show how models of each sensor compare.")
    ] = False,
    view: Annotated[
        Path | None,
        typer.Option(
            "--rerun",
            metavar="FILE.rrd",
            help="Write map, drive, sensors and misfits for Rerun's 3-D viewer, too.",
        ),
    ] = None,
) -> None:
    """Calibrate every magnetometer of one drive or several; write a picture and a report, too."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import CALIBRATION_FILE, OVERVIEW_FILE, calibrate_bags
        from l2m_gtsam.batch.reports import REPORT_FILE, report_calibration
        from l2m_gtsam.cli.tables.verdict_text import verdict_lines
        from l2m_gtsam.config import load_config, with_uncertainty

        chosen = with_uncertainty(load_config(config), uncertainty)
        drives = [*(bags or ()), *(more or ())]
        found = calibrate_bags(drives, map_path, chosen, out, progress, view=view)
        verdict = report_calibration(out, found, chosen.qa, progress)
    _print_calibration(found.result, models)
    typer.echo("\n".join(verdict_lines(verdict)))
    written = [out / name for name in (CALIBRATION_FILE, OVERVIEW_FILE, REPORT_FILE)]
    typer.echo(f"written: {', '.join(map(str, [*written, *([view] if view else [])]))}")


@app.command()
def plan(
    bag: BagArgument,
    map_path: MapOption,
    config: ConfigOption = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Assume a sensor at this place in the lidar frame (metres), instead of those of "
            "the bag; may be repeated.",
        ),
    ] = None,
) -> None:
    """Say what a drive will determine, how well, and which extra motion would help most.

    From poses and map alone: the bag needs no readings. Sensors of the bag are assumed where
    `calibration.start` puts them, else at the lidar, aligned with it and without distortion.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import plan_bag
        from l2m_gtsam.cli.tables.plan_tables import (
            advice,
            held_plan_note,
            motion_table,
            plan_table,
        )
        from l2m_gtsam.config import load_config
        from l2m_gtsam.storage.calibration_file import UNCERTAINTY

        chosen, places = load_config(config), [_place(text) for text in at or []]
        found = plan_bag(bag, map_path, chosen, places, progress)
    print_table(plan_table(found))
    if held := held_plan_note(found):
        typer.echo(held)
    print_table(motion_table(found))
    typer.echo(advice(found))
    typer.echo(UNCERTAINTY[found.uncertainty])
    warn(found.doubts)


@app.command()
def demo(
    out: OutOption = Path("demo_out"),
    options: ScenarioOption = None,
    seed: SeedOption = None,
) -> None:
    """Simulate, map and calibrate a warehouse, and compare with the truth."""
    with shown_progress() as progress:
        from l2m_gtsam.cli.demo import run_demo
        from l2m_gtsam.cli.tables.tables import honesty_note, truth_table

        wanted = _scenario(options, seed)
        outcome = run_demo(out, wanted, progress)
    print_table(truth_table(outcome.result, outcome.truth))
    typer.echo(honesty_note(outcome.result, outcome.truth))
    typer.echo(f"picture: {outcome.picture}; report: {outcome.report}; everything else is in {out}")


@map_app.command("build")
def map_build(
    bags: BagsArgument,
    out: MapFileOption,
    config: ConfigOption = None,
    suite: SuiteOption = None,
    structure: StructureOption = None,
    lidar: Annotated[
        bool,
        typer.Option(
            "--lidar",
            help="Save the cloud of the bags' scans with the map, to localise drives on that have "
            "point clouds and no poses.",
        ),
    ] = False,
    tiles: TilesOption = True,
) -> None:
    """Build a map from one or several bags of a calibrated mapping suite."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.files import make_tiles
        from l2m_gtsam.batch.maps import build_map_file
        from l2m_gtsam.cli.tables.tables import map_table
        from l2m_gtsam.config import load_config

        built = build_map_file(bags, out, load_config(config), suite, progress, structure, lidar)
        if tiles:
            make_tiles(built.field_map, out, progress)
    print_table(map_table(built.description))
    warn(built.description.summary.doubts)
    typer.echo(f"written: {out}")


@map_app.command("update")
def map_update(
    map_path: MapArgument,
    bags: BagsArgument,
    out: MapFileOption,
    config: ConfigOption = None,
    suite: SuiteOption = None,
    tiles: TilesOption = True,
) -> None:
    """Add bags to a map, which keeps its kind, its options and the prior of the whole map.

    Where there are new readings, the scales of a harmonic map's tiles follow them.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.files import make_tiles
        from l2m_gtsam.batch.maps import update_map_file
        from l2m_gtsam.cli.tables.tables import map_table
        from l2m_gtsam.config import load_config

        updated = update_map_file(map_path, bags, out, load_config(config), suite, progress)
        if tiles:
            make_tiles(updated.field_map, out, progress)
    print_table(map_table(updated.description))
    warn(updated.description.summary.doubts)
    typer.echo(f"written: {out}")


@map_app.command("compare")
def map_compare(
    bags: BagsArgument,
    config: ConfigOption = None,
    suite: SuiteOption = None,
    structure: StructureOption = None,
) -> None:
    """Say which kind of map predicts places best that it has not seen."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.maps import compare_map_kinds
        from l2m_gtsam.cli.tables.comparison import comparison_table
        from l2m_gtsam.config import load_config

        comparison = compare_map_kinds(bags, load_config(config), suite, structure, progress)
    print_table(comparison_table(comparison))


@map_app.command("info")
def map_info(map_path: MapArgument) -> None:
    """Say what a map is made of and what it covers."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.maps import describe_map_file
        from l2m_gtsam.cli.tables.tables import map_table

        description = describe_map_file(map_path, progress)
    print_table(map_table(description))
    warn(description.summary.doubts)


@map_app.command("plot")
def map_plot(
    map_path: MapArgument,
    out: Annotated[Path, typer.Option("--out", help="Picture to write (.png).")],
    height: Annotated[
        float | None, typer.Option(help="Height in metres; the middle of the readings if absent.")
    ] = None,
) -> None:
    """Draw strength and uncertainty of a map at one height."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.maps import plot_map_file

        plot_map_file(map_path, out, height, progress)
    typer.echo(f"written: {out}")


def _scenario(options: Path | None, seed: int | None) -> "ScenarioOptions":
    """Return what is simulated: the default, or that of a file; a seed stands above both."""
    from l2m_gtsam.config import load_options
    from l2m_gtsam.simulate.scenario import ScenarioOptions

    wanted = ScenarioOptions() if options is None else load_options(options, ScenarioOptions)
    return wanted if seed is None else wanted.model_copy(update={"seed": seed})


def _place(text: str) -> tuple[float, float, float]:
    """Return the three numbers of an option."""
    from math import isfinite

    from l2m_gtsam.errors import ConfigError

    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = float("nan")
    if not (isfinite(x) and isfinite(y) and isfinite(z)):
        raise ConfigError(
            f"--at: {text!r} is not a place; accepted: three numbers, x,y,z in metres"
        )
    return x, y, z


def _print_calibration(result: "CalibrationResult", models: bool) -> None:
    """Print what came out, and what its reader should know."""
    from l2m_gtsam.cli.tables.model_table import model_note, model_tables
    from l2m_gtsam.cli.tables.tables import (
        calibration_table,
        disagreement_note,
        held_clocks_note,
        missing_note,
    )
    from l2m_gtsam.storage.calibration_file import UNCERTAINTY

    print_table(calibration_table(result))
    for note in result.notes:
        typer.echo(note)
    typer.echo(UNCERTAINTY[result.uncertainty])
    warn(result.doubts)
    warn(missing_note(result))
    warn([disagreement_note(each) for each in result.disagreements])
    if held := held_clocks_note(result):
        typer.echo(held)
    for table in model_tables(result) if models else ():
        print_table(table)
    for note in filter(None, map(model_note, result.sensors)):
        typer.echo(note)

"""``l2m inspect``, ``plan``, ``calibrate`` and ``batch``: from bags to calibrations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from l2m_gtsam.cli.terminal import (
    LOGS,
    BagArgument,
    ConfigOption,
    MapOption,
    OutOption,
    PosesOption,
    PoseTimesOption,
    SchedulerOption,
    StrictOption,
    WideOption,
    WorkersOption,
    end_with,
    print_table,
    print_verdict,
    say,
    say_written,
    shown_progress,
    warn,
)

if TYPE_CHECKING:
    from l2m_gtsam.batch.fleet import Fleet
    from l2m_gtsam.records.calibration import CalibrationResult


def inspect(
    bag: BagArgument,
    config: ConfigOption = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
    wide: WideOption = False,
) -> None:
    """List what is in a log, what would be used and why; exit code 1 if it cannot be calibrated."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import inspect_file
        from l2m_gtsam.cli.tables.drives import bag_table
        from l2m_gtsam.config import load_config, with_poses

        chosen = with_poses(load_config(config), [bag], poses or (), times)
        report = inspect_file(bag, chosen, progress)
    print_table(bag_table(report), wide)
    say(*report.notes)
    say(*(f"cannot be calibrated as it is: {each}" for each in report.obstacles))
    say("clock: record time less header stamp, median; |B|: lowest - median - highest")
    if report.obstacles:
        raise typer.Exit(1)


def config(
    key: Annotated[
        str | None, typer.Argument(metavar="[KEY]", help="Only this part: bag, calibration.solve.")
    ] = None,
    bag: Annotated[
        Path | None,
        typer.Option("--for", metavar="BAG", help="A configuration to start from, for this log."),
    ] = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
) -> None:
    """Print every option with its default and meaning, or a configuration for a log, as YAML."""
    from l2m_gtsam.errors import ConfigError

    if bag is None:
        from l2m_gtsam.batch.options_text import options_text

        typer.echo(options_text(key), nl=False)
        return
    if key is not None:
        raise ConfigError("--for: makes a whole configuration; leave out KEY")
    with shown_progress() as progress:
        from l2m_gtsam.batch.starting_config import starting_config
        from l2m_gtsam.config import Config, with_poses
        from l2m_gtsam.progress import counter

        given = with_poses(Config(), [bag], poses or (), times).bag
        text = starting_config(bag, given, counter(f"reading {bag.name}", progress))
    typer.echo(text, nl=False)


def plan(
    bag: BagArgument,
    map_path: MapOption,
    config: ConfigOption = None,
    at: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Assume a sensor at this position in the lidar frame (metres), instead of those "
            "of the bag; may be repeated.",
        ),
    ] = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
    wide: WideOption = False,
) -> None:
    """Predict what a drive will determine, how accurately, and which extra motion helps most.

    From poses and map alone: the bag needs no readings. Sensors of the bag are assumed where
    `calibration.start` puts them, else at the lidar, aligned with it and without distortion.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import plan_bag
        from l2m_gtsam.cli.tables.drives import (
            advice,
            held_plan_note,
            motion_table,
            noise_note,
            plan_table,
        )
        from l2m_gtsam.config import load_config, with_poses
        from l2m_gtsam.storage.calibration_file import UNCERTAINTY

        chosen = with_poses(load_config(config), [bag], poses or (), times)
        places = [_place(text) for text in at or []]
        found = plan_bag(bag, map_path, chosen, places, progress)
    print_table(plan_table(found), wide)
    say(noise_note(found))
    if held := held_plan_note(found):
        say(held)
    print_table(motion_table(found), wide)
    say(advice(found))
    say(UNCERTAINTY[found.uncertainty])
    say(*found.notes)
    warn(found.doubts)


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


def calibrate(
    map_path: MapOption,
    out: OutOption,
    bags: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="BAG...",
            help=f"{LOGS}; several of one vehicle are calibrated together and compared.",
        ),
    ] = None,
    more: Annotated[
        list[Path] | None,
        typer.Option("--bag", metavar="BAG", help="A drive, as BAG; may be repeated."),
    ] = None,
    config: ConfigOption = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
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
    strict: StrictOption = False,
    wide: WideOption = False,
) -> None:
    """Calibrate every magnetometer of one drive or several; write a picture and a report, too."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.drives import CALIBRATION_FILE, OVERVIEW_FILE, calibrate_bags
        from l2m_gtsam.batch.reports import REPORT_FILE, calibration_results, report_calibration
        from l2m_gtsam.config import load_config, with_poses, with_uncertainty

        drives = [*(bags or ()), *(more or ())]
        chosen = with_poses(load_config(config), drives, poses or (), times)
        chosen = with_uncertainty(chosen, uncertainty)
        with calibration_results(out) as stage:
            found = calibrate_bags(drives, map_path, chosen, stage, progress, view=view)
            verdict = report_calibration(stage, found, chosen.qa, progress)
    _print_calibration(found.result, models, wide)
    print_verdict(verdict)
    written = [out / name for name in (CALIBRATION_FILE, OVERVIEW_FILE, REPORT_FILE)]
    say_written([*written, *([view] if view else [])], found.result.report_id)
    end_with(verdict.level, strict)


def _print_calibration(result: "CalibrationResult", models: bool, wide: bool) -> None:
    """Print what came out, and what its reader should know."""
    from l2m_gtsam.cli.tables.calibration import (
        calibration_table,
        disagreement_note,
        held_clocks_note,
        missing_note,
        model_note,
        model_tables,
        status_lines,
    )
    from l2m_gtsam.storage.calibration_file import UNCERTAINTY

    print_table(calibration_table(result), wide)
    say(*status_lines(result))
    say(*result.notes)
    say(UNCERTAINTY[result.uncertainty])
    warn(result.doubts)
    warn(missing_note(result))
    warn([disagreement_note(each) for each in result.disagreements])
    if held := held_clocks_note(result):
        say(held)
    for table in model_tables(result) if models else ():
        print_table(table, wide)
    say(*filter(None, map(model_note, result.sensors)))


def batch(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER|MANIFEST",
            help="Folder with bags, or YAML that lists them; docs/fleet.md.",
        ),
    ],
    out: OutOption,
    map_path: Annotated[
        Path | None,
        typer.Option("--map", help="Map file, for all bags that a manifest gives none."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML configuration, likewise; its `fleet` is for the page."),
    ] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="End with exit code 3 if a sensor's verdict is FAIL, or a bag fails."
        ),
    ] = False,
) -> None:
    """Calibrate a folder or a manifest of bags; write index.html, fleet.csv and fleet.parquet.

    A bag that fails is a row with its reason; only --strict changes the exit code. Started again
    with the same --out it computes only what is missing or has changed.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.fleet import run_fleet
        from l2m_gtsam.batch.fleet_task import CSV_FILE, PAGE_FILE, PARQUET_FILE, FleetOrder
        from l2m_gtsam.parallel.cluster import ClusterOptions

        order = FleetOrder(source, map_path, config, out)
        cluster = ClusterOptions(
            scheduler=scheduler, **({} if workers is None else {"workers": workers})
        )
        fleet = run_fleet(order, cluster, progress)
    say(_summary(fleet))
    for row in fleet.rows:
        if row.error:
            say(f"not calibrated: {row.vehicle}, {row.bag}: {row.error}")
    warn(fleet.notes)
    written = [PAGE_FILE, CSV_FILE, *([] if fleet.notes else [PARQUET_FILE])]
    say(f"written: {', '.join(str(out / name) for name in written)}")
    end_with(fleet.level, strict)


def _summary(fleet: "Fleet") -> str:
    """Return one line about all drives."""
    from l2m_gtsam.qa.report.fleet_page import tally

    count = tally(fleet.rows)
    return (
        f"{_counted(count.drives, 'drive')} of {_counted(count.vehicles, 'vehicle')}: "
        f"{count.drives - count.failed} calibrated, {count.failed} not; sensors: "
        f"{count.passed} pass, {count.warned} warn, {count.rejected} fail, {count.outliers} "
        f"outliers; {fleet.computed} computed now"
    )


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"

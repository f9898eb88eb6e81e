"""``l2m map``: maps of the magnetic field, and the suite of sensors that surveys them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from l2m_gtsam.cli.terminal import (
    ConfigOption,
    PosesOption,
    PoseTimesOption,
    WideOption,
    print_table,
    say,
    shown_progress,
    warn,
)

if TYPE_CHECKING:
    from l2m_gtsam.batch.maps import DescribedMap

map_app = typer.Typer(
    help="Build, update, compare, describe and draw magnetic maps; calibrate a mapping suite.",
    no_args_is_help=True,
)
MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="Map file.")]
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
        help="The LiDAR's point cloud: .pcd, .ply, .las, .laz, .e57 or .npz in the map frame, or a "
        "PointCloud2 topic.",
    ),
]
TilesOption = Annotated[
    bool,
    typer.Option(
        help="Make all tiles of the map now and keep them in the folder MAP.tiles beside it; else "
        "each is made, and kept, when it is first needed."
    ),
]
MapFileOption = Annotated[Path, typer.Option("--out", help="Map file to write (.npz).")]


@map_app.command("suite")
def suite(
    bags: Annotated[
        list[Path], typer.Argument(metavar="BAG...", help="Mapping bags of one vehicle.")
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Calibration to write (.yaml), for --suite and others.")
    ],
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML configuration; see `mapping.suite` in it.")
    ] = None,
    known: Annotated[
        Path | None,
        typer.Option(
            "--suite",
            help="What is known of the sensors; ideal ones at the lidar's origin if not given.",
        ),
    ] = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
    wide: WideOption = False,
) -> None:
    """Calibrate a mapping suite from its own drive, before there is any map.

    Poses must be accurate; the field need not be known: no possible field fits the readings of
    sensors with other positions or calibrations.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.survey import calibrate_suite_file
        from l2m_gtsam.cli.tables.calibration import calibration_table, status_lines
        from l2m_gtsam.config import load_config, with_poses

        chosen = with_poses(load_config(config), bags, poses or (), times)
        found = calibrate_suite_file(bags, out, chosen, known, progress)
    print_table(calibration_table(found), wide)
    say(*status_lines(found))
    warn(found.doubts)
    say(f"written: {out}")


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
    poses: PosesOption = None,
    times: PoseTimesOption = None,
) -> None:
    """Build a map from one or several bags of a calibrated mapping suite."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.files import make_tiles
        from l2m_gtsam.batch.maps import build_map_file
        from l2m_gtsam.config import load_config, with_poses

        chosen = with_poses(load_config(config), bags, poses or (), times)
        built = build_map_file(bags, out, chosen, suite, progress, structure, lidar)
        if tiles:
            make_tiles(built.field_map, out, progress)
    _print_map(built)
    warn(built.field_map.summary.doubts)
    say(f"written: {out}")


@map_app.command("update")
def map_update(
    map_path: MapArgument,
    bags: BagsArgument,
    out: MapFileOption,
    config: ConfigOption = None,
    suite: SuiteOption = None,
    changes: Annotated[
        bool,
        typer.Option(
            "--changes",
            help="The place may have changed: report what came, went or was moved, between which "
            "dates, and drop what no longer holds. Needs a calibrated vehicle (--suite).",
        ),
    ] = False,
    tiles: TilesOption = True,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
) -> None:
    """Add bags to a map, which keeps its kind, its options and the prior of the whole map.

    Where there are new readings, the scales of a harmonic map's tiles follow them.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.files import make_tiles
        from l2m_gtsam.batch.maps import keep_map_file_up, update_map_file
        from l2m_gtsam.config import load_config, with_poses

        chosen = with_poses(load_config(config), bags, poses or (), times)
        update = keep_map_file_up if changes else update_map_file
        updated = update(map_path, bags, out, chosen, suite, progress)
        if tiles:
            make_tiles(updated.field_map, out, progress)
    _print_map(updated)
    warn(updated.field_map.summary.doubts)
    say(f"written: {out}")


def _print_map(described: "DescribedMap") -> None:
    """Print what a map is, and what changed since its survey."""
    from l2m_gtsam.cli.tables.maps import changes_table, faded_lines, map_table

    print_table(map_table(described))
    if described.diary is not None:
        print_table(changes_table(described.diary))
        say(*faded_lines(described.diary))


@map_app.command("compare")
def map_compare(
    bags: BagsArgument,
    config: ConfigOption = None,
    suite: SuiteOption = None,
    structure: StructureOption = None,
    poses: PosesOption = None,
    times: PoseTimesOption = None,
    wide: WideOption = False,
) -> None:
    """Compare kinds of map by how well they predict readings that were left out."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.maps import compare_map_kinds
        from l2m_gtsam.cli.tables.maps import comparison_table
        from l2m_gtsam.config import load_config, with_poses

        chosen = with_poses(load_config(config), bags, poses or (), times)
        comparison = compare_map_kinds(bags, chosen, suite, structure, progress)
    print_table(comparison_table(comparison), wide)


@map_app.command("info")
def map_info(map_path: MapArgument) -> None:
    """Describe a map: what it was made from, what it covers, how good it is."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.files import doubts_of_origin
        from l2m_gtsam.batch.maps import describe_map_file

        described = describe_map_file(map_path, progress)
    _print_map(described)
    warn([*described.field_map.summary.doubts, *doubts_of_origin(described.provenance)])


@map_app.command("plot")
def map_plot(
    map_path: MapArgument,
    out: Annotated[Path, typer.Option("--out", help="Picture to write (.png).")],
    height: Annotated[
        float | None, typer.Option(help="Height in metres; the middle of the readings if absent.")
    ] = None,
) -> None:
    """Draw strength and uncertainty of a map at one height, and what changed."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.maps import plot_map_file

        plot_map_file(map_path, out, height, progress)
    say(f"written: {out}")

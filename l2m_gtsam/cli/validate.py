"""``l2m validate``: whether a calibration still holds."""

from pathlib import Path
from typing import Annotated

import typer

from l2m_gtsam.cli.terminal import print_table, shown_progress


def validate(
    calibration: Annotated[
        Path, typer.Option("--calibration", help="calibration.yaml of `l2m calibrate`.")
    ],
    bag: Annotated[
        Path | None,
        typer.Argument(metavar="[BAG]", help="Another drive: ROS1 .bag, ROS2 folder, .db3, .mcap."),
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help="Map file of the place of the drive.")
    ] = None,
    compare: Annotated[
        Path | None,
        typer.Option(help="An older calibration.yaml: what has changed since? Needs no BAG."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML configuration; that of the calibration if absent."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for validation.json and validation.html."),
    ] = None,
) -> None:
    """Say whether a calibration still holds: on another drive and map, or beside an older one.

    Readings are predicted from poses, map and calibration with all that is uncertain of these.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.validation import (
            PAGE_FILE,
            VALIDATION_FILE,
            ValidationRequest,
            validate_calibration,
        )
        from l2m_gtsam.cli.tables.validation import change_table, validation_lines, validation_table

        asked = ValidationRequest(calibration, bag, map_path, compare, config, out)
        found = validate_calibration(asked, progress)
    if found.drive is not None:
        print_table(validation_table(found.drive, found.verdict))
    if found.comparison is not None:
        print_table(change_table(found.comparison))
    for line in validation_lines(found.verdict):
        typer.echo(line)
    if out is not None:
        typer.echo(f"written: {out / VALIDATION_FILE}, {out / PAGE_FILE}")

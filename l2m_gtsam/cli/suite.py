"""``l2m map suite``: the sensors of a mapping suite, from their own drive."""

from pathlib import Path
from typing import Annotated

import typer

from l2m_gtsam.cli.terminal import print_table, shown_progress, warn


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
) -> None:
    """Calibrate a mapping suite from its own drive, before there is any map.

    Poses have to be known well, the field does not: no field that can be looks the same to sensors
    that sit or read otherwise.
    """
    with shown_progress() as progress:
        from l2m_gtsam.batch.survey import calibrate_suite_file
        from l2m_gtsam.cli.tables.tables import calibration_table
        from l2m_gtsam.config import load_config

        found = calibrate_suite_file(bags, out, load_config(config), known, progress)
    print_table(calibration_table(found))
    warn(found.doubts)
    typer.echo(f"written: {out}")

"""``l2m batch``: many drives of many vehicles."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from l2m_gtsam.cli.terminal import shown_progress, warn

if TYPE_CHECKING:
    from l2m_gtsam.batch.fleet import Fleet


def batch(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER|MANIFEST",
            help="Folder with bags, or YAML that lists them; docs/fleet.md.",
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")],
    map_path: Annotated[
        Path | None,
        typer.Option("--map", help="Map file, for all bags that a manifest gives none."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML configuration, likewise; its `fleet` is for the page."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; as many as there are cores if not given.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="TCP://HOST:PORT", help="A running Dask cluster that computes."),
    ] = None,
) -> None:
    """Calibrate a folder or a manifest of bags; write index.html, fleet.csv and fleet.parquet.

    A bag that fails is a row with its reason, and the exit code stays 0. Started again with the
    same --out it computes only what is missing or has changed.
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
    typer.echo(_summary(fleet))
    for row in fleet.rows:
        if row.error:
            typer.echo(f"not calibrated: {row.vehicle}, {row.bag}: {row.error}")
    warn(fleet.notes)
    written = [PAGE_FILE, CSV_FILE, *([] if fleet.notes else [PARQUET_FILE])]
    typer.echo(f"written: {', '.join(str(out / name) for name in written)}")


def _summary(fleet: "Fleet") -> str:
    """Return one line about all drives."""
    from l2m_gtsam.qa.fleet.page import tally

    count = tally(fleet.rows)
    return (
        f"{_counted(count.drives, 'drive')} of {_counted(count.vehicles, 'vehicle')}: "
        f"{count.drives - count.failed} calibrated, {count.failed} not; sensors: "
        f"{count.passed} pass, {count.warned} warn, {count.rejected} fail, {count.outliers} "
        f"outliers; {fleet.computed} computed now"
    )


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"

"""``l2m report``: what a person looks at, and signs."""

from pathlib import Path
from typing import Annotated

import typer

from l2m_gtsam.cli.terminal import shown_progress


def report(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder that `l2m calibrate` or `l2m slam` wrote to."),
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", help="YAML configuration whose `qa` has the thresholds of the verdict."
        ),
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf", help="Write report.pdf, too: needs Chromium, Chrome or Edge.")
    ] = False,
) -> None:
    """Write report.html: verdict, reasons, pictures; needs no bag and no map."""
    with shown_progress() as progress:
        from l2m_gtsam.batch.reports import PDF_FILE, REPORT_FILE, report_folder
        from l2m_gtsam.cli.tables.verdict_text import verdict_lines

        verdict = report_folder(folder, config, progress, pdf=pdf)
    for line in verdict_lines(verdict):
        typer.echo(line)
    written = [folder / REPORT_FILE, *([folder / PDF_FILE] if pdf else [])]
    typer.echo(f"written: {', '.join(map(str, written))}")

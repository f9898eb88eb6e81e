"""``l2m study``: studies of many calibrations whose truth is known."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from l2m_gtsam.cli.terminal import shown_progress


def study(
    name: Annotated[str, typer.Argument(metavar="STUDY", help="Its name; see docs/studies.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")],
    options: Annotated[
        Path | None, typer.Option("--options", help="YAML with the study's options.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of everything random, instead of that in --options.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; as many as there are cores if not given.")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="TCP://HOST:PORT", help="A running Dask cluster that computes."),
    ] = None,
) -> None:
    """Run a study: table1, basin, ablation, honesty or scaling.

    Started again with the same --out it goes on where it was stopped.
    """
    with shown_progress() as progress:
        from l2m_gtsam.config import load_options
        from l2m_gtsam.errors import ConfigError
        from l2m_gtsam.parallel.cluster import ClusterOptions
        from l2m_gtsam.studies.registry import STUDIES
        from l2m_gtsam.studies.run import run_study

        if name not in STUDIES:
            raise ConfigError(f"study {name!r} is not known; accepted: {', '.join(STUDIES)}")
        chosen = STUDIES[name]
        wanted = chosen.options() if options is None else load_options(options, chosen.options)
        if seed is not None:
            wanted = wanted.model_copy(update={"seed": seed})
        cluster = ClusterOptions(
            scheduler=scheduler, **({} if workers is None else {"workers": workers})
        )
        command = shlex.join(
            ["l2m", "study", name, *(["--options", str(options)] if options else [])]
        )
        made = run_study(chosen, wanted, out, cluster, progress, f"{command} --seed {wanted.seed}")
    typer.echo(chosen.page(made.summary))
    typer.echo(f"written: {out / f'{name}.md'}")

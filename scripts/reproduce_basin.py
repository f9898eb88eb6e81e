"""Reproduce the paper's success rates over initial offsets: ``python scripts/reproduce_basin.py``.

Writes basin.json, basin.md and basin.png; started again with the same --out it goes on where it
was stopped, also with more distortions or rings.
"""

import os
import sys
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import typer

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
# Small blocks: threads would wait for each other; has to be said before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from l2m_gtsam.studies.basin import Cell


def main(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("basin_out"),
    distortions: Annotated[int, typer.Option(min=1, help="Random sensors.")] = 20,
    starts: Annotated[int, typer.Option(min=1, help="Starts of each sensor in each ring.")] = 100,
    lm_starts: Annotated[int, typer.Option(min=1, help="Of them, those that LM gets.")] = 20,
    rings: Annotated[int, typer.Option(min=1, help="Rings of 0.25 m.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Of drives, sensors and starts.")] = 1,
    processes: Annotated[int, typer.Option(min=1, help="How many compute.")] = 1,
) -> None:
    """Count calibrations that end at the truth, by how far from it they start."""
    from l2m_gtsam.studies.basin import BasinOptions
    from l2m_gtsam.studies.basin_report import basin_markdown
    from l2m_gtsam.studies.basin_run import run_basin

    begin = monotonic()

    def tell(cell: "Cell", share: float) -> None:
        place = f"distortion {cell.distortion}, ring {cell.ring}"
        typer.echo(f"{monotonic() - begin:8.1f} s {share:7.1%}: {place}", err=True)

    options = BasinOptions(
        distortions=distortions, starts=starts, lm_starts=lm_starts, rings=rings, seed=seed
    )
    typer.echo(basin_markdown(run_basin(options, out, processes, tell)))


if __name__ == "__main__":
    typer.run(main)

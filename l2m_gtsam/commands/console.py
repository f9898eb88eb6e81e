"""What all commands say the same way."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from l2m_gtsam.progress import Progress


def warn(doubts: Sequence[str]) -> None:
    """Say on the error stream what speaks against a result that was written all the same."""
    for doubt in doubts:
        typer.echo(f"l2m: warning: {doubt}", err=True)


@contextmanager
def progress_bars() -> Iterator["Progress"]:
    """Show one bar per stage on the error stream while it runs."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description:<28}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as bars:
        stages: dict[str, TaskID] = {}

        def tell(stage: str, fraction: float) -> None:
            if stage not in stages:
                stages[stage] = bars.add_task(stage, total=1.0)
            bars.update(stages[stage], completed=fraction)

        yield tell

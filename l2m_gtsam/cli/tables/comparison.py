"""Kinds of maps side by side in the terminal."""

from rich.markup import escape
from rich.table import Table

from l2m_gtsam.maps.compare import KindFigures, KindResult, MapComparison

HEADINGS = (
    "log-likelihood",
    "rmse (uT)",
    "x y z (uT)",
    "shared rmse (uT)",
    "z-score std",
    "in 95 %",
    "inside",
    "noise (uT)",
    "build (s)",
)


def comparison_table(comparison: MapComparison) -> Table:
    """Return one row per kind of map: how it predicts held-out readings, or why it failed.

    Figures are of the readings inside each map, "shared" of those inside all maps; only the
    log-likelihood is of all readings.
    """
    table = Table(
        title=f"Maps compared on {comparison.readings:,} readings in {comparison.patches:,} "
        f"patches of {comparison.fold:.3g} m, held out in {comparison.folds} folds",
        title_justify="left",
        caption=escape(recommendation(comparison)),
        caption_justify="left",
    )
    table.add_column("kind")
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    failed = any(result.figures is None for result in comparison.kinds)
    if failed:
        table.add_column("failed", overflow="fold")
    for result in comparison.kinds:
        row = _row(result)
        style = "green" if result.kind == comparison.recommended else None
        table.add_row(*(row if failed else row[:-1]), style=style)
    return table


def recommendation(comparison: MapComparison) -> str:
    """Return which kind is recommended and why, as a sentence."""
    if comparison.recommended is None:
        return comparison.reason
    return f"recommended: {comparison.recommended}; {comparison.reason}"


def _row(result: KindResult) -> tuple[str, ...]:
    figures = result.figures
    cells = ("-",) * len(HEADINGS) if figures is None else _cells(figures)
    return (escape(result.kind), *cells, escape(result.reason))


def _cells(figures: KindFigures) -> tuple[str, ...]:
    return (
        f"{figures.log_likelihood:.3f}",
        f"{figures.rmse:.3f}",
        " ".join(f"{value:.3f}" for value in figures.rmse_axes),
        f"{figures.rmse_shared:.3f}",
        f"{figures.z_std:.2f}",
        f"{figures.coverage:.3f}",
        f"{figures.inside:.1%}",
        f"{figures.noise:.3f}",
        f"{figures.seconds:.1f}",
    )

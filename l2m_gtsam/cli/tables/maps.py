"""Magnetic maps in the terminal: what one is made of, and kinds of maps beside each other."""

from typing import Any

from rich.markup import escape
from rich.table import Table

from l2m_gtsam.batch.maps import MapDescription
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


def map_table(description: MapDescription) -> Table:
    """Return what a map is made of, what it covers and where it came from."""
    summary = description.summary
    table = Table("fact", "value", title="Magnetic map", title_justify="left")
    table.add_row("kind", summary.kind)
    table.add_row("readings given, rows kept", f"{summary.readings:,}, {summary.rows:,}")
    for axis, low, high in zip("xyz", summary.lower, summary.upper, strict=True):
        table.add_row(f"readings along {axis}", f"{low:.2f} to {high:.2f} m")
    for name, value in summary.facts.items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        table.add_row(escape(name), escape(shown))
    for name in ("frame", "version"):
        table.add_row(name, escape(str(description.provenance.get(name, "unknown"))))
    for source in _bags(description.provenance):
        table.add_row("made from", escape(", ".join(str(value) for value in source.values())))
    for name, shown in (("structure", "structure"), ("lidar", "cloud of scans")):
        if isinstance(parts := description.provenance.get(name), dict):
            facts = (f"{part.replace('_', ' ')} {value}" for part, value in parts.items())
            table.add_row(shown, escape(", ".join(facts)))
    return table


def _bags(provenance: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the bags in a map file, which may have been tampered with."""
    bags = provenance.get("bags")
    return [each for each in bags if isinstance(each, dict)] if isinstance(bags, list) else []

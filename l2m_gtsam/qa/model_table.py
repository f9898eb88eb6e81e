"""Models of a magnetometer side by side in the terminal."""

from rich.markup import escape
from rich.table import Table

from l2m_gtsam.model_results import ModelComparison, ModelFigures

HEADINGS = (
    "parameters",
    "rms (uT)",
    "held out (uT)",
    "score",
    "behind the best",
    "BIC above the least",
)


def model_table(sensor: str, comparison: ModelComparison) -> Table:
    """Return one row per model of a sensor: how it fits, and how it predicts held-out segments.

    The score is the mean logarithm of the density of a held-out reading; "behind the best" is by
    how much it is less than the best that the BIC admits.
    """
    numbers = f", {', '.join(comparison.regressors)}" if comparison.regressors else ""
    table = Table(
        title=f"Models of {escape(sensor)}{escape(numbers)}: {comparison.readings:,} readings that "
        f"count as {comparison.independent:,.0f}, {comparison.segments} segments held out in turn",
        title_justify="left",
        caption=f"recommended: {comparison.recommended}; {comparison.reason}",
        caption_justify="left",
    )
    table.add_column("model", no_wrap=True)
    for heading in HEADINGS:
        table.add_column(heading, justify="right")
    for fit in comparison.fits:
        style = "green" if fit.model is comparison.recommended else None
        table.add_row(*_row(fit), style=style)
    return table


def _row(fit: ModelFigures) -> tuple[str, ...]:
    return (
        fit.model.value,
        str(fit.parameters),
        f"{fit.rms:.3f}",
        f"{fit.held_out_rms:.3f}",
        f"{fit.held_out_score:.3f} ± {fit.score_error:.3f}",
        f"{fit.behind:.3f} ± {fit.behind_error:.3f}",
        f"{fit.bic_above:.1f}",
    )

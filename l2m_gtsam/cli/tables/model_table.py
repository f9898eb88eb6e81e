"""Models of a magnetometer side by side in the terminal."""

from rich.markup import escape
from rich.table import Table

from l2m_gtsam.records.calibration import CalibrationResult, SensorCalibration
from l2m_gtsam.records.sensor_models import Model, ModelComparison, ModelFigures, MovingField

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


def model_tables(result: CalibrationResult) -> list[Table]:
    """Return the models of every sensor of which they are compared."""
    compared = ((each.sensor, each.models) for each in result.sensors)
    return [model_table(sensor, models) for sensor, models in compared if models is not None]


def model_note(sensor: SensorCalibration) -> str:
    """Return which model its readings ask for and what moves in it; nothing for the usual one."""
    models = sensor.models
    if models is None or models.recommended is Model.FULL:
        return ""
    moving = "".join(f"; {_moving(each)}" for each in sensor.moving)
    return f"model of {sensor.sensor}: {models.recommended} ({models.reason}){moving}"


def _moving(found: MovingField) -> str:
    each = zip(found.h.tolist(), found.sigma.tolist(), strict=True)
    return f"{found.name}: " + ", ".join(f"{h:.3g} ± {sigma:.1g}" for h, sigma in each) + " uT each"

"""Calibrations in the terminal: sensors, models of a sensor, and truth."""

import numpy as np
from rich.markup import escape
from rich.table import Table

from l2m_gtsam.cli.tables import OPEN, held_note, new_table, sigmas_cell, vector_cell
from l2m_gtsam.data import FloatArray, KnownSensor
from l2m_gtsam.qa.verdict.places import stretch_head
from l2m_gtsam.records.calibration import (
    CalibrationResult,
    Disagreement,
    SensorCalibration,
    SensorStatus,
    TimeOffset,
)
from l2m_gtsam.records.sensor_models import Model, ModelComparison, ModelFigures, MovingField
from l2m_gtsam.text import significant, with_sigma

HEADINGS = (
    "t_lidar_mag (m)",
    "± (mm)",
    "H (uT)",
    "± (uT)",
    "rotation (deg)",
    "± (deg)",
    "clock (ms)",
    "rms (uT)",
    "used",
    "rejected",
    "outside map",
    "|C - R| max",
)
WIDTH = 8  # of a coordinate: rows are below each other
METRES, MILLIMETRES = "7.4f", "5.1f"  # of a table of errors, row by row alike
MODEL_HEADINGS = (
    "score",
    "behind the best",
    "rms (uT)",
    "held out (uT)",
    "parameters",
    "BIC above the least",
)


def calibration_table(result: CalibrationResult) -> Table:
    """Return one row per sensor: position, H and rotation with their sigmas, clock, readings."""
    title = "Calibration: B_meas = C @ B_lidar + H; rms: length of residuals; ±: one sigma"
    table = new_table(title, ("sensor", "status"), HEADINGS)
    for sensor in result.sensors:
        table.add_row(*_calibration_row(sensor))
    return table


def _calibration_row(sensor: SensorCalibration) -> tuple[str, ...]:
    name, status = escape(sensor.sensor), _status(sensor)
    if sensor.residuals is None:
        counts = (f"{sensor.rejected:,}", f"{sensor.outside_map:,}")
        return (name, status, *("-",) * 9, *counts, "-")
    distortion, R = sensor.distortion, sensor.R_lidar_mag.T
    angle = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    return (
        name,
        status,
        vector_cell(sensor.t_lidar_mag, sensor.t_sigma, WIDTH),
        sigmas_cell(1e3 * sensor.t_sigma),
        vector_cell(distortion.H, sensor.H_sigma, WIDTH),
        sigmas_cell(sensor.H_sigma),
        vector_cell(np.array([angle]), sensor.turn_sigma_deg.max(keepdims=True)),
        sigmas_cell(sensor.turn_sigma_deg),
        _clock(sensor.time_offset),
        f"{sensor.residuals.rms:.3f}",
        f"{sensor.residuals.readings:,}",
        f"{sensor.rejected:,}",
        f"{sensor.outside_map:,}",
        f"{np.abs(distortion.C - R).max():.3f}",
    )


def status_lines(result: CalibrationResult) -> list[str]:
    """Return what is to be said of sensors that are not solved, or rest on priors, a line each."""
    lines = []
    for sensor in result.sensors:
        if sensor.status is not SensorStatus.SOLVED:
            lines.append(f"{sensor.sensor}: {sensor.status.value}: {sensor.message}")
        elif sensor.from_priors:
            lines.append(f"{sensor.sensor}: from priors: {', '.join(sensor.from_priors)}")
    return lines


def _clock(offset: TimeOffset | None) -> str:
    """Return a time offset in milliseconds with its sigma; a dash where it is held at zero."""
    if offset is None or not offset.estimated:
        return "-"
    return with_sigma(1e3 * offset.seconds, 1e3 * offset.sigma)


def _status(sensor: SensorCalibration) -> str:
    colour = "green" if sensor.status is SensorStatus.SOLVED else "yellow"
    return f"[{colour}]{sensor.status.value}[/]"


def disagreement_note(stretch: Disagreement) -> str:
    """Return where, when and by how much readings and map disagree, as a sentence."""
    (x0, y0), (x1, y1) = stretch.p_from[:2], stretch.p_to[:2]
    head = stretch_head(stretch)
    where = f"{stretch.bag}: " if stretch.bag else ""
    return (
        f"{where}{', '.join(stretch.sensors)}: {stretch.readings} readings fit neither map nor "
        f"distortion and do not count, {1e-9 * stretch.start_ns:.2f} to "
        f"{1e-9 * stretch.end_ns:.2f} s, "
        f"{stretch.length:.1f} m from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) m, "
        f"{significant(stretch.size, 2)} uT off; {head[:1].lower()}{head[1:]}"
    )


def missing_note(result: CalibrationResult) -> tuple[str, ...]:
    """Return which sensors are calibrated from some of several drives only, a sentence each."""
    return tuple(
        f"{sensor.sensor}: nothing usable was read in {', '.join(sensor.missing_in)}; it is "
        "calibrated from the rest"
        for sensor in result.sensors
        if sensor.missing_in and len(sensor.missing_in) < len(result.bags)
    )


def held_clocks_note(result: CalibrationResult) -> str:
    """Return which sensors' time offsets are taken as zero and why, as a sentence; else nothing."""
    offsets = ((sensor.sensor, sensor.time_offset) for sensor in result.sensors)
    return held_note({name: each.held for name, each in offsets if each and each.held})


def truth_table(result: CalibrationResult, truth: tuple[KnownSensor, ...]) -> Table:
    """Return truth, estimate, error and sigma of every sensor's position, and errors of C and H."""
    errors = ("t error (mm)", "sigma (mm)", "|H error| (uT)", "sigma (uT)")
    others = ("|C error|", "sigma of C", "true t (m)", "estimated t (m)")
    table = new_table("Truth and estimate", ("sensor",), [*errors, *others])
    for known in truth:
        table.add_row(*_truth_row(known, result[known.sensor]))
    return table


def _truth_row(known: KnownSensor, sensor: SensorCalibration) -> tuple[str, ...]:
    name, true = escape(known.sensor), _in_places(known.t_lidar_mag, METRES)
    if sensor.residuals is None:
        return (name, _status(sensor), *("-",) * 5, true, "-")
    C_error = np.linalg.norm(sensor.distortion.C - known.distortion.C)
    H_error = np.linalg.norm(sensor.distortion.H - known.distortion.H)
    return (
        name,
        _in_places(1e3 * (sensor.t_lidar_mag - known.t_lidar_mag), MILLIMETRES),
        _in_places(1e3 * sensor.t_sigma, MILLIMETRES),
        *_length(H_error, np.linalg.norm(sensor.H_sigma)),
        *_length(C_error, np.linalg.norm(sensor.C_sigma)),
        true,
        _in_places(sensor.t_lidar_mag, METRES),
    )


def _in_places(values: FloatArray, form: str) -> str:
    """Return a vector whose rows are below each other; a dash for what is not determined."""
    return " ".join(format(each, form) if np.isfinite(each) else OPEN for each in values.tolist())


def _length(error: np.floating, sigma: np.floating) -> tuple[str, str]:
    """Return the length of an error and its standard deviation as two cells."""
    size = np.array([sigma])
    return vector_cell(np.array([error]), size), sigmas_cell(size)


def consistency_note(result: CalibrationResult, truth: tuple[KnownSensor, ...]) -> str:
    """Return how the errors of all positions compare with their sigmas, as a sentence."""
    pairs = [(result[known.sensor], known.t_lidar_mag) for known in truth]
    ratios = [
        float(error / sigma)
        for sensor, t in pairs
        if sensor.residuals is not None
        for error, sigma in zip(sensor.t_lidar_mag - t, sensor.t_sigma, strict=True)
        if np.isfinite(sigma)
    ]
    if not ratios:
        return "no position was determined"
    rms = float(np.sqrt(np.mean(np.square(ratios))))
    return f"errors of t are {rms:.1f} times their sigmas (rms, expected 1)"


def model_tables(result: CalibrationResult) -> list[Table]:
    """Return the models of every sensor of which they are compared."""
    compared = ((each.sensor, each.models) for each in result.sensors)
    return [model_table(sensor, models) for sensor, models in compared if models is not None]


def model_table(sensor: str, comparison: ModelComparison) -> Table:
    """Return one row per model of a sensor: how it fits, and how it predicts held-out segments.

    The score is the mean logarithm of the density of a held-out reading; "behind the best" is by
    how much it is less than the best that the BIC admits.
    """
    numbers = f", {', '.join(comparison.regressors)}" if comparison.regressors else ""
    table = new_table(
        f"Models of {escape(sensor)}{escape(numbers)}: {comparison.readings:,} readings "
        f"with the information of {comparison.independent:,.0f} independent ones, "
        f"{comparison.segments} segments held out in turn",
        ("model",),
        MODEL_HEADINGS,
        f"recommended: {comparison.recommended}; {comparison.reason}",
    )
    for fit in comparison.fits:
        style = "green" if fit.model is comparison.recommended else None
        table.add_row(*_model_row(fit), style=style)
    return table


def _model_row(fit: ModelFigures) -> tuple[str, ...]:
    return (
        fit.model.value,
        with_sigma(fit.held_out_score, fit.score_error),
        with_sigma(fit.behind, fit.behind_error),
        f"{fit.rms:.3f}",
        f"{fit.held_out_rms:.3f}",
        str(fit.parameters),
        f"{fit.bic_above:.1f}",
    )


def model_note(sensor: SensorCalibration) -> str:
    """Return which model its readings ask for and what moves in it; nothing for the usual one."""
    models = sensor.models
    if models is None or models.recommended is Model.FULL:
        return ""
    moving = "".join(f"; {_moving(each)}" for each in sensor.moving)
    return f"model of {sensor.sensor}: {models.recommended} ({models.reason}){moving}"


def _moving(found: MovingField) -> str:
    each = zip(found.h.tolist(), found.sigma.tolist(), strict=True)
    return f"{found.name}: {', '.join(with_sigma(h, sigma) for h, sigma in each)} uT each"

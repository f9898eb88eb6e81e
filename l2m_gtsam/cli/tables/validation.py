"""A validation in the terminal."""

import numpy as np
from rich.markup import escape
from rich.table import Table

from l2m_gtsam.cli.tables import coloured, new_table
from l2m_gtsam.records.validation import (
    CalibrationComparison,
    ComparedSensor,
    DriveValidation,
    FieldError,
    ValidatedSensor,
)
from l2m_gtsam.records.verdict import Verdict
from l2m_gtsam.text import significant, with_sigma


def validation_table(drive: DriveValidation, verdict: Verdict) -> Table:
    """Return one row per sensor: field errors before and after, NIS, and the verdict."""
    figures = ("e_B before", "e_B after", "NIS", "readings", "rejected", "outside")
    table = new_table(
        "Readings beside pose, map and calibration",
        ("sensor", "verdict"),
        (*figures, "distance", "x", "y", "z"),
        "e_B: mean squared distance to the map's field (uT^2); distance and axes (of the lidar): "
        "mean ± std after the calibration (uT); NIS per degree of freedom, in brackets where 95 % "
        "of all lie",
    )
    levels = {each.sensor: each.level for each in verdict.sensors}
    for sensor in drive.sensors:
        name = escape(sensor.sensor)
        table.add_row(name, coloured(levels[sensor.sensor]), *_figures(sensor))
    for each in drive.missing:
        table.add_row(escape(each.sensor), coloured(levels[each.sensor]), *("-",) * 10)
    return table


def _figures(sensor: ValidatedSensor) -> tuple[str, ...]:
    nis = sensor.nis
    return (
        significant(sensor.before.squared),
        significant(sensor.after.squared),
        f"{nis.ratio:.2f} ({nis.low / nis.freedom:.2f} - {nis.high / nis.freedom:.2f})",
        f"{sensor.readings:,}",
        f"{sensor.rejected:,}",
        f"{sensor.outside:,}",
        f"{sensor.after.mean:.3f} ± {sensor.after.std:.3f}",
        *_axes(sensor.after),
    )


def _axes(error: FieldError) -> list[str]:
    pairs = zip(error.mean_axes, error.std_axes, strict=True)
    return [f"{mean:.3f} ± {std:.3f}" for mean, std in pairs]


def change_table(comparison: CalibrationComparison) -> Table:
    """Return one row per sensor: differences with their sigmas, and the chi-square tests."""
    table = new_table(
        "New less old calibration",
        ("sensor",),
        ("all", "place", "rotation", "H", "gains", "angles", "C", "less t (mm)", "less H (uT)"),
        "chi-square / degrees of freedom over each part and all; ! where chance makes as much less "
        "than once in 1,000 times",
    )
    for sensor in comparison.sensors:
        table.add_row(*_comparison_row(sensor))
    for each in comparison.missing:
        table.add_row(escape(each.sensor), *("-",) * 9)
    return table


def _comparison_row(sensor: ComparedSensor) -> tuple[str, ...]:
    d, sigma = np.array(sensor.difference), np.array(sensor.sigma)
    names = ("all", "place", "rotation", "offset", "gains", "angles", "C")
    return (
        escape(sensor.sensor),
        *(_test(sensor, name) for name in names),
        _with_sigmas(1e3 * d[:3], 1e3 * sigma[:3]),
        _with_sigmas(d[12:], sigma[12:]),
    )


def _with_sigmas(values: np.ndarray, sigmas: np.ndarray) -> str:
    pairs = zip(values, sigmas, strict=True)
    return "  ".join(with_sigma(v, s) for v, s in pairs)


def _test(sensor: ComparedSensor, name: str) -> str:
    test = sensor.test(name)
    mark = " !" if test.chance < 1e-3 else ""
    return f"{test.chi_square:.1f} / {test.freedom}{mark}" if test.freedom else "-"

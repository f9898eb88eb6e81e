"""How the parameters of a sensor depend on each other."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.drawing import Drawing
from l2m_gtsam.qa.report.panel import Box, Panel, Stroke, fill, letters
from l2m_gtsam.qa.report.scale import COLOURS, colours, shades
from l2m_gtsam.qa.report.svg import PAPER, SMALL
from l2m_gtsam.records.calibration import SensorCalibration

HEIGHT = 4.0  # inches
MATRIX = Box(34, 10, 240, 240)
BAR = Box(286, 29, 10, 202)
NAMES = ("tx", "ty", "tz", *(f"C{r}{c}" for r in "xyz" for c in "xyz"), "Hx", "Hy", "Hz")


def correlations(sensor: SensorCalibration) -> FloatArray:
    """Return the correlations of (t, C row by row, H), NaN for what is open, shape (15, 15)."""
    variance = np.diag(sensor.covariance)
    known = np.isfinite(variance) & (variance > 0)
    sigma = np.sqrt(np.where(known, variance, 1.0))
    rho = np.where(np.isfinite(sensor.covariance), sensor.covariance, 0) / np.outer(sigma, sigma)
    rho[~known, :] = np.nan
    rho[:, ~known] = np.nan
    return np.asarray(rho)


def correlation_figure(sensor: SensorCalibration) -> Drawing:
    """Draw the correlations as a matrix; what is not determined stays blank."""
    rho, ends = correlations(sensor), (-0.5, 14.5)
    matrix, bar = Panel(MATRIX, ends, ends), Panel(BAR, (0, 1), (-1, 1))
    column, row = np.meshgrid(np.arange(15.0), 14 - np.arange(15.0))  # the first row is on top
    palette, shade = colours("PuOr"), shades(np.nan_to_num(rho), bar.y)
    for number in np.unique(shade[np.isfinite(rho)]):
        own = (shade == number) & np.isfinite(rho)
        sides = np.column_stack([column[own] - 0.5, column[own] + 0.5])
        matrix.bars(sides, row[own] - 0.5, row[own] + 0.5, fill(palette[number]))
    for edge in (2.5, 11.5):
        matrix.level(14 - edge, Stroke(PAPER, 2))
        matrix.upright(edge, Stroke(PAPER, 2))
    _names(matrix)
    # Strong ones are told by their sign, too.
    for i, j in zip(*np.nonzero(np.abs(np.tril(np.nan_to_num(rho), -1)) > 0.5), strict=True):
        sign = "+" if rho[i, j] > 0 else "−"
        x, y = float(matrix.across(j)), float(matrix.down(14 - i))
        matrix.text(x, y + 3, sign, letters("middle", SMALL, "white"))
    steps = np.linspace(-1, 1, COLOURS + 1)
    # Each to the end, below the next: there is no seam between two.
    for low, colour in zip(steps[:-1], palette, strict=True):
        bar.bars(np.array([[0.0, 1.0]]), np.array([low]), np.ones(1), fill(colour))
    for value in (-1, -0.5, 0, 0.5, 1):
        words = f"{value:.1f}".replace("-", "−")
        bar.text(BAR.right + 5, float(bar.down(value)) + 3.5, words, letters("start"))
    return Drawing(HEIGHT, (matrix, bar))


def _names(matrix: Panel) -> None:
    for k, name in enumerate(NAMES):
        x, y = float(matrix.across(k)), float(matrix.down(14 - k))
        matrix.text(MATRIX.left - 5, y + 3, name, letters("end", SMALL))
        at = f"translate({x + 3:.1f} {MATRIX.bottom + 6:.1f}) rotate(-90)"
        matrix.parts.append(f'<text transform="{at}" style="{letters("end", SMALL)}">{name}</text>')

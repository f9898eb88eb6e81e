"""Statistics of a sensor: chi-square and autocorrelation of residuals, tests, correlations."""

import numpy as np

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.drawing import (
    COLOURS,
    Drawing,
    LegendEntry,
    Panel,
    Rectangle,
    Stroke,
    colours,
    fill,
    legend,
    letters,
    paint,
    shades,
    usual,
)
from l2m_gtsam.qa.report.hover import cells, strips
from l2m_gtsam.qa.report.svg import BAD, GRID, INK, MUTED, PAPER, SMALL, X, Y
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.metrics import Normalised, SensorMetrics
from l2m_gtsam.records.record import Row
from l2m_gtsam.solve.chi_square import density
from l2m_gtsam.text import with_sigma

CUT = 7.81  # 95 % of chi-square of three
ALIKE = 3.0  # sigmas: of fifteen parameters one is beyond in 4 % of all drives
HEIGHT = 2.9  # inches
NAMES = ("tx", "ty", "tz", *(f"C{r}{c}" for r in "xyz" for c in "xyz"), "Hx", "Hy", "Hz")
BAR = 0.35  # half of a bar's width
ZERO = Stroke(MUTED, 0.7)
BAND = Stroke(GRID, 8)  # as it is in a legend
HEIGHT_OF_MATRIX = 4.0  # inches
MATRIX = Rectangle(34, 10, 240, 240)
SCALE = Rectangle(286, 29, 10, 202)
EXPECTED = Stroke(INK, dashes=(4.1, 1.8))


def chi_square_figure(found: Normalised) -> Drawing:
    """Draw squared normalised residuals beside the chi-square that they should have."""
    edges, counts = np.array(found.edges), np.array(found.counts)
    read = counts / max(counts.sum(), 1) / np.diff(edges)
    r2 = np.linspace(edges[0], edges[-1], 200)
    expected = density(r2, 3)
    room = 0.05 * float(edges[-1] - edges[0])
    high = 1.05 * max(float(read.max()), float(expected.max()))
    panel = Panel(usual(HEIGHT), (float(edges[0]) - room, float(edges[-1]) + room), (0.0, high))
    panel.x_axis("squared normalised residual (last bar: all beyond)")
    panel.y_axis("density")
    sides = np.column_stack([edges[:-1], edges[1:]])
    panel.bars(sides, np.zeros(len(read)), read, fill(X, 0.5))
    panel.line(r2, expected, EXPECTED)
    panel.upright(CUT, Stroke(MUTED, 0.8, dashes=(0.8, 1.3)))
    beyond = f"{found.beyond_95:.1%} beyond (5 %)"
    at = panel.box.top + 0.4 * panel.box.height + 14
    panel.text(float(panel.across(CUT)) + 4, at, beyond, letters("start", SMALL))
    panel.frame()
    samples = [
        LegendEntry("read", Stroke(X, 8, alpha=0.5)),
        LegendEntry("expected: chi-square of 3", EXPECTED),
    ]
    legend(panel, samples)
    figure = Drawing(HEIGHT, (panel,))
    words = [
        f"{a:.1f} to {b:.1f}: {number} readings, density {high:.3f}"
        for (a, b), number, high in zip(sides, found.counts, read, strict=True)
    ]
    strips(figure, sides.mean(axis=1), words)
    return figure


def autocorrelation_figure(sensor: SensorMetrics) -> Drawing:
    """Draw the autocorrelation of residuals over the number of readings between them."""
    found = sensor.autocorrelation
    lags, correlation = np.array(found.lags, dtype=float), np.array(found.correlation)
    # Of white noise the autocorrelation is normal with variance 1 / N (Bartlett 1946).
    bound = 1.96 / np.sqrt(max(sensor.fit.readings, 1))
    room = 0.05 * float(np.ptp(lags)) if len(lags) > 1 else 1.0
    ends = (float(lags.min()) - room, float(lags.max()) + room) if len(lags) else (0.0, 1.0)
    panel = Panel(usual(HEIGHT), ends, (-0.35, 1.05))
    panel.x_axis("readings apart")
    panel.y_axis("correlation")
    panel.bars(np.array([ends]), np.array([-bound]), np.array([bound]), fill(GRID))
    known = np.isfinite(correlation)
    lags, correlation = lags[known], correlation[known]
    feet = np.column_stack([np.zeros(len(lags)), correlation, np.full(len(lags), np.nan)])
    panel.line(np.repeat(lags, 3), feet.ravel(), Stroke(Y, 1.2))
    panel.dots(lags, correlation, 4.2, Y, 1.0)
    panel.level(0, ZERO)
    panel.frame()
    legend(panel, [LegendEntry("chance (95 %)", BAND)])
    figure = Drawing(HEIGHT, (panel,))
    words = [f"{lag:.0f} apart: {rho:+.2f}" for lag, rho in zip(lags, correlation, strict=True)]
    strips(figure, lags, words)
    return figure


def halves_figure(sensor: SensorMetrics) -> Drawing:
    """Draw by how many sigmas both halves of the drive differ, parameter by parameter."""
    label = "second less first half (sigmas)"
    return sigmas_figure(sensor.halves.difference, sensor.halves.sigma, label)


def sigmas_figure(difference: Row, sigma_of: Row, label: str) -> Drawing:
    """Draw differences of the 15 parameters in sigmas; what is open stays blank."""
    d, sigma = np.array(difference), np.array(sigma_of)
    known = np.isfinite(sigma) & (sigma > 0)
    ratio = np.where(known, d, 0) / np.where(known, sigma, 1)
    high = max(1.4 * ALIKE, 1.15 * float(np.abs(ratio).max()))
    panel = Panel(usual(HEIGHT), (-1.1, 15.1), (-high, high))
    panel.y_axis(label)
    panel.bars(np.array([panel.x]), np.array([-ALIKE]), np.array([ALIKE]), fill(GRID))
    place, beyond = np.arange(15.0), np.abs(ratio) > ALIKE
    sides, feet = np.column_stack([place - BAR, place + BAR]), np.zeros(15)
    panel.bars(sides[~beyond], feet[~beyond], ratio[~beyond], fill(X))
    marked = f"fill:{paint(BAD)};stroke:{paint(INK)};stroke-width:1.2"
    panel.bars(sides[beyond], feet[beyond], ratio[beyond], marked)
    panel.level(0, ZERO)
    for x, name in zip(panel.across(place), NAMES, strict=True):
        at = f"translate({x + 3:.1f} {panel.box.bottom + 11:.1f}) rotate(-60)"
        panel.parts.append(f'<text transform="{at}" style="{letters("end", SMALL)}">{name}</text>')
    panel.frame()
    legend(panel, [LegendEntry(f"± {ALIKE:g} sigmas", BAND)])
    figure = Drawing(HEIGHT, (panel,))
    strips(figure, place, list(map(_difference_words, NAMES, d, sigma, known)))
    return figure


def _difference_words(name: str, difference: float, sigma: float, known: bool) -> str:
    """Return a parameter's difference in its unit with its sigma."""
    unit = {"t": "m", "C": "", "H": "µT"}[name[0]]
    if not known:
        return f"{name}: not determined"
    shown = with_sigma(difference, sigma, unit, signed=True)
    return f"{name}: {shown}, {difference / sigma:+.1f} sigmas"


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
    matrix, bar = Panel(MATRIX, ends, ends), Panel(SCALE, (0, 1), (-1, 1))
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
    # Strong ones have a sign, too: colours are not all that readers see.
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
        bar.text(SCALE.right + 5, float(bar.down(value)) + 3.5, words, letters("start"))
    figure = Drawing(HEIGHT_OF_MATRIX, (matrix, bar))
    below = np.nonzero(np.tril(np.isfinite(rho)))  # the same as above the diagonal
    labels = [f"{NAMES[j]} and {NAMES[i]}: {rho[i, j]:+.2f}" for i, j in zip(*below, strict=True)]
    cells(figure, matrix, np.column_stack([below[1], 14 - below[0]]).astype(float), labels)
    return figure


def _names(matrix: Panel) -> None:
    for k, name in enumerate(NAMES):
        x, y = float(matrix.across(k)), float(matrix.down(14 - k))
        matrix.text(MATRIX.left - 5, y + 3, name, letters("end", SMALL))
        at = f"translate({x + 3:.1f} {MATRIX.bottom + 6:.1f}) rotate(-90)"
        matrix.parts.append(f'<text transform="{at}" style="{letters("end", SMALL)}">{name}</text>')


def strongest_correlation(sensor: SensorCalibration) -> str:
    """Return the pair of parameters of the largest correlation, with that."""
    lower = np.abs(np.tril(np.nan_to_num(correlations(sensor)), -1))
    i, j = np.unravel_index(int(np.argmax(lower)), lower.shape)
    return f"{NAMES[j]} and {NAMES[i]}, {correlations(sensor)[i, j]:+.2f}"

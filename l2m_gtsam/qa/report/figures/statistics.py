"""Whether residuals are what the noise says: their chi-square, and their correlation in time."""

import numpy as np

from l2m_gtsam.qa.report.drawing import Drawing, Entry, legend, usual
from l2m_gtsam.qa.report.panel import Panel, Stroke, fill, letters, paint
from l2m_gtsam.qa.report.svg import BAD, GRID, INK, MUTED, SMALL, X, Y
from l2m_gtsam.records.metrics import Normalised, Row, SensorMetrics
from l2m_gtsam.solve.chi_square import density

CUT = 7.81  # 95 % of chi-square of three
ALIKE = 3.0  # sigmas: of fifteen parameters one is beyond in 4 % of all drives
HEIGHT = 2.9  # inches
NAMES = ("tx", "ty", "tz", *(f"C{r}{c}" for r in "xyz" for c in "xyz"), "Hx", "Hy", "Hz")
BAR = 0.35  # half of a bar's width
ZERO = Stroke(MUTED, 0.7)
BAND = Stroke(GRID, 8)  # as it is in a legend
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
        Entry("read", Stroke(X, 8, alpha=0.5)),
        Entry("expected: chi-square of 3", EXPECTED),
    ]
    legend(panel, samples)
    return Drawing(HEIGHT, (panel,))


def autocorrelation_figure(sensor: SensorMetrics) -> Drawing:
    """Draw how alike residuals are that lie some readings apart."""
    found = sensor.autocorrelation
    lags, correlation = np.array(found.lags, dtype=float), np.array(found.correlation)
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
    legend(panel, [Entry("chance (95 %)", BAND)])
    return Drawing(HEIGHT, (panel,))


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
    legend(panel, [Entry(f"± {ALIKE:g} sigmas", BAND)])
    return Drawing(HEIGHT, (panel,))

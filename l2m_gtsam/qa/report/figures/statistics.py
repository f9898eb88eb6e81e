"""Whether residuals are what the noise says: their chi-square, and their correlation in time."""

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from l2m_gtsam.metric_results import Normalised, Row, SensorMetrics
from l2m_gtsam.qa.report.svg import BAD, GRID, INK, MUTED, SMALL, X, Y, plain_figure

CUT = 7.81  # 95 % of chi-square of three
ALIKE = 3.0  # sigmas: of fifteen parameters one is beyond in 4 % of all drives


def chi_square_figure(found: Normalised) -> Figure:
    """Draw squared normalised residuals beside the chi-square that they should have."""
    figure = plain_figure(2.9)
    axes = figure.add_subplot()
    edges, counts = np.array(found.edges), np.array(found.counts)
    density = counts / max(counts.sum(), 1) / np.diff(edges)
    axes.stairs(density, edges, fill=True, color=X, alpha=0.5, label="read")
    r2 = np.linspace(edges[0], edges[-1], 200)
    axes.plot(r2, chi2.pdf(r2, 3), "--", color=INK, label="expected: chi-square of 3")
    axes.axvline(CUT, color=MUTED, linewidth=0.8, linestyle=":")
    axes.annotate(
        f"{found.beyond_95:.1%} beyond (5 %)",
        (CUT, 0.6),
        xycoords=("data", "axes fraction"),
        xytext=(4, -14),
        textcoords="offset points",
        fontsize=SMALL,
    )
    axes.set(xlabel="squared normalised residual (last bar: all beyond)", ylabel="density")
    axes.legend(loc="upper right")
    return figure


def autocorrelation_figure(sensor: SensorMetrics) -> Figure:
    """Draw how alike residuals are that lie some readings apart."""
    figure = plain_figure(2.9)
    axes = figure.add_subplot()
    found = sensor.autocorrelation
    bound = 1.96 / np.sqrt(max(sensor.fit.readings, 1))
    axes.axhspan(-bound, bound, color=GRID, label="chance (95 %)")
    markers, stems, base = axes.stem(found.lags, found.correlation, basefmt=" ")
    markers.set(color=Y, markersize=3.5)
    stems.set(color=Y, linewidth=1.2)
    base.set(color=MUTED)
    axes.axhline(0, color=MUTED, linewidth=0.7)
    axes.set(xlabel="readings apart", ylabel="correlation", ylim=(-0.35, 1.05))
    axes.legend(loc="upper right")
    return figure


def halves_figure(sensor: SensorMetrics) -> Figure:
    """Draw by how many sigmas both halves of the drive differ, parameter by parameter."""
    label = "second less first half (sigmas)"
    return sigmas_figure(sensor.halves.difference, sensor.halves.sigma, label)


def sigmas_figure(difference: Row, sigma_of: Row, label: str) -> Figure:
    """Draw differences of the 15 parameters in sigmas; what is open stays blank."""
    figure = plain_figure(2.9)
    axes = figure.add_subplot()
    d, sigma = np.array(difference), np.array(sigma_of)
    known = np.isfinite(sigma) & (sigma > 0)
    ratio = np.where(known, d, 0) / np.where(known, sigma, 1)
    names = ["tx", "ty", "tz", *(f"C{r}{c}" for r in "xyz" for c in "xyz"), "Hx", "Hy", "Hz"]
    place = np.arange(15)
    axes.axhspan(-ALIKE, ALIKE, color=GRID, label=f"± {ALIKE:g} sigmas")
    beyond = np.abs(ratio) > ALIKE
    axes.bar(place[~beyond], ratio[~beyond], color=X, width=0.7)
    axes.bar(place[beyond], ratio[beyond], color=BAD, width=0.7, hatch="//", edgecolor=INK)
    axes.axhline(0, color=MUTED, linewidth=0.7)
    figure.subplots_adjust(bottom=0.17)
    axes.set_xticks(place, names, rotation=60, fontsize=SMALL)
    high = max(1.4 * ALIKE, 1.15 * float(np.abs(ratio).max()))
    axes.set(ylabel=label, ylim=(-high, high))
    axes.grid(visible=False, axis="x")
    axes.legend(loc="upper right")
    return figure

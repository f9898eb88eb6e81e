"""How the parameters of a sensor depend on each other."""

import numpy as np
from matplotlib.figure import Figure

from l2m_gtsam.data import FloatArray
from l2m_gtsam.qa.report.svg import PAPER, SMALL, plain_figure
from l2m_gtsam.results import SensorCalibration

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


def correlation_figure(sensor: SensorCalibration) -> Figure:
    """Draw the correlations as a matrix; what is not determined stays blank."""
    figure = plain_figure(4.0)
    axes, bar = figure.add_axes((0.1, 0.13, 0.7, 0.83)), figure.add_axes((0.84, 0.2, 0.03, 0.7))
    rho = correlations(sensor)
    drawn = axes.imshow(rho, cmap="PuOr", vmin=-1, vmax=1)
    axes.set_xticks(range(15), NAMES, rotation=90, fontsize=SMALL)
    axes.set_yticks(range(15), NAMES, fontsize=SMALL)
    axes.grid(visible=False)
    for edge in (2.5, 11.5):
        axes.axhline(edge, color=PAPER, linewidth=2)
        axes.axvline(edge, color=PAPER, linewidth=2)
    # Strong ones are told by their sign, too.
    for i, j in zip(*np.nonzero(np.abs(np.tril(np.nan_to_num(rho), -1)) > 0.5), strict=True):
        axes.text(
            j,
            i,
            "+" if rho[i, j] > 0 else "−",
            ha="center",
            va="center",
            color="white",
            fontsize=SMALL,
        )
    figure.colorbar(drawn, cax=bar, ticks=[-1, -0.5, 0, 0.5, 1])
    return figure


def _sign(value: float) -> str:
    return "+" if value > 0 else "−"

"""How far neighbouring readings err together."""

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.metrics.evidence import SensorEvidence
from l2m_gtsam.qa.metrics.plain import row
from l2m_gtsam.records.metrics import Autocorrelation

LAGS = 40


def autocorrelation(evidence: SensorEvidence) -> Autocorrelation:
    """Return the correlation of normalised residuals over the number of readings between them."""
    white = evidence.white[evidence.used]
    readings = evidence.readings.select(evidence.used)
    within = np.diff(readings.of_drive) == 0
    rho = correlation(white, min(LAGS, len(white) // 3), readings.drive)
    steps = np.diff(readings.stamp_ns)[within]
    step = float(np.median(steps)) * 1e-9 if len(steps) else float("nan")
    return Autocorrelation(
        lags=tuple(range(len(rho))),
        correlation=row(rho, 4),
        step_s=step,
        independent=len(white) / lasting(rho),
    )


def correlation(series: FloatArray, lags: int, drive: IntArray | None = None) -> FloatArray:
    """Return the autocorrelation of the columns of a series, shape (N, K), mean over the columns.

    Of lags 0 to ``lags``, shape (lags + 1,); by the fast Fourier transform, without wrapping.
    Values of different drives, shape (N,) and ascending, are not compared.
    """
    centred = series - series.mean(axis=0)
    of = np.zeros(len(series)) if drive is None else drive
    power = np.zeros(lags + 1)
    for own in np.split(centred, np.flatnonzero(np.diff(of)) + 1):
        # Twice as long as both are, so that nothing wraps.
        spectrum = np.fft.rfft(own, 2 * max(len(own), lags + 1), axis=0)
        power += np.fft.irfft(np.abs(spectrum) ** 2, axis=0)[: lags + 1].sum(axis=1)
    return np.asarray(power / power[0]) if power[0] > 0 else np.eye(1, lags + 1)[0]


def lasting(rho: FloatArray) -> float:
    """Return how many readings are worth an independent one: 1 + 2 sum of the correlation.

    Up to where it first falls below zero: beyond that it is noise.
    """
    below = np.flatnonzero(rho < 0)
    end = int(below[0]) if len(below) else len(rho)
    return float(1 + 2 * rho[1:end].sum())

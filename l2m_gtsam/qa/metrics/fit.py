"""How well readings fit the map: residuals, their correlation, field errors and curves."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.metrics.evidence import SensorEvidence
from l2m_gtsam.qa.metrics.plain import evenly, row, rows
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.metrics import Autocorrelation, CurveErrors, FitFigures, Normalised, Series
from l2m_gtsam.records.validation import FieldError
from l2m_gtsam.solve.chi_square import quantile
from l2m_gtsam.solve.closed_form import refitted

BINS = 24
LAGS = 40


def fit_figures(evidence: SensorEvidence, noise: float) -> FitFigures:
    """Return residuals, and what sensor, map and poses contribute to them."""
    used = evidence.used
    e, B = evidence.residual[used], evidence.B_map[used]
    poses = np.einsum("nii->n", evidence.pose_share[used]) / 3
    return FitFigures(
        readings=int(used.sum()),
        sensor_noise=noise,
        map_noise=float(np.sqrt(evidence.map_variance[used].mean())),
        pose_noise=float(np.sqrt(poses.mean())),
        mean=row(e.mean(axis=0)),
        rms=row(np.sqrt(np.mean(e**2, axis=0))),
        anomaly=float(np.sqrt(np.mean((B - B.mean(axis=0)) ** 2))),
        without_map=_without_map(evidence),
    )


def _without_map(evidence: SensorEvidence) -> float:
    """Return what is left of the readings if the field is the same everywhere.

    As the map has it on the mean; C and H are those that explain the readings best then.
    """
    used = evidence.used
    R, z = evidence.readings.R_map_lidar[used], evidence.readings.field[used]
    return refitted(np.einsum("nji,j->ni", R, evidence.B_map[used].mean(axis=0)), z)


def normalised_figures(evidence: SensorEvidence) -> Normalised:
    """Return how the residuals compare with the noise that the solve assumed."""
    white = evidence.white[evidence.used]
    squared = np.sum(white**2, axis=1)
    edges = np.linspace(0, quantile(0.999, 3), BINS + 1)
    # White residuals of three axes: their squared length is chi-square of three.
    counts, _ = np.histogram(np.minimum(squared, edges[-1]), edges)
    return Normalised(
        std=row(white.std(axis=0), 4),
        edges=row(edges, 4),
        counts=tuple(counts.tolist()),
        beyond_95=float(np.mean(squared > quantile(0.95, 3))),
    )


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
    # Wiener-Khinchin: the inverse transform of the power spectrum is the autocorrelation.
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
    # The integrated autocorrelation time; its window is the initial positive sequence (Geyer 1992).
    below = np.flatnonzero(rho < 0)
    end = int(below[0]) if len(below) else len(rho)
    return float(1 + 2 * rho[1:end].sum())


def field_error(field: FloatArray, of_map: FloatArray) -> FieldError:
    """Return the difference of fields along the axes of the lidar, both in uT, shape (N, 3)."""
    difference = field - of_map
    length = np.linalg.norm(difference, axis=1)
    return FieldError(
        squared=float(np.mean(length**2)),
        mean=float(length.mean()),
        std=float(length.std()),
        mean_axes=row(difference.mean(axis=0)),
        std_axes=row(difference.std(axis=0)),
    )


@dataclass(frozen=True)
class Curves:
    """Readings along the lidar's axes in uT, shape (N, 3).

    Attributes
    ----------
    before
        As read: of a sensor that is taken to be ideal and aligned with the lidar.
    after
        Corrected.
    map
        Of the map at the sensor's place.
    """

    before: FloatArray
    after: FloatArray
    map: FloatArray


def curves(evidence: SensorEvidence, sensor: SensorCalibration) -> Curves:
    """Return the three for all readings of a sensor inside the map; NaN where C has no inverse."""
    z = evidence.readings.field
    # A dead axis leaves nothing to correct.
    sound = np.linalg.cond(sensor.distortion.C) < 1e6
    after = sensor.distortion.undo(z) if sound else np.full_like(z, np.nan)
    return Curves(z, after, evidence.b_lidar)


def curve_errors(found: Curves, evidence: SensorEvidence) -> CurveErrors:
    """Return how far readings are from the map's, of those that count."""
    before = (found.before - found.map)[evidence.used]
    after = (found.after - found.map)[evidence.used]
    return CurveErrors(
        before=float(np.mean(np.sum(before**2, axis=1))),
        after=float(np.mean(np.sum(after**2, axis=1))),
        before_axes=row(np.abs(before).mean(axis=0), 4),
        after_axes=row(np.abs(after).mean(axis=0), 4),
        after_std=row(after.std(axis=0), 4),
    )


def series(found: Curves, evidence: SensorEvidence, start_ns: IntArray, most: int) -> Series:
    """Return the course of all drives in at most so many readings, evenly spread.

    ``start_ns`` is when each drive starts, by its number.
    """
    keep = evenly(len(evidence.used), most)
    own = evidence.readings.of_drive[keep]
    return Series(
        seconds=row(1e-9 * (evidence.readings.stamp_ns[keep] - start_ns[own]), 2),
        place=rows(evidence.place[keep], 2),
        residual=rows(evidence.residual[keep], 3),
        normalised=rows(evidence.white[keep], 2),
        rejected=tuple((~evidence.used[keep]).tolist()),
        before=rows(found.before[keep], 2),
        after=rows(found.after[keep], 2),
        map=rows(found.map[keep], 2),
        drive=None if evidence.readings.drive is None else tuple(own.tolist()),
    )

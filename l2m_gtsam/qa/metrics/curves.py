"""Readings before and after the calibration, beside those of the map: the paper's BC, AC, MR."""

from dataclasses import dataclass

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.qa.metrics.evidence import SensorEvidence
from l2m_gtsam.qa.metrics.plain import evenly, row, rows
from l2m_gtsam.records.calibration import SensorCalibration
from l2m_gtsam.records.metrics import CurveErrors, Series


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

"""Whether a disagreement is of the place, of the moment, of the vehicle or of one sensor.

All four are amplitudes of known fields, compared by the likelihood of the same readings:

- place: the source's field, in all passages and at all sensors alike;
- moment: the same in one passage only;
- vehicle: an offset in the frame of each sensor, alike wherever it is on;
- sensor: the source's field, or such an offset, at one sensor only.
"""

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.sources.found_sources import FoundSources, price
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.records.places import Cause, CauseGain, ChangedSource
from l2m_gtsam.solve.linear_algebra import right_divided

DETECTED_UT = 0.2  # weaker a source is not detected
DETECTED_SHARE = 0.2  # of its strongest field: where a passage begins and ends
APART = 30  # slots from one passage to the next
REJECTED = 0.5  # share of the readings of an average, from which it disagrees


def changed_sources(
    rows: MarginalRows, drive: AveragedDrive, found: FoundSources
) -> tuple[ChangedSource, ...]:
    """Return sources with what else would explain each of them.

    Parameters
    ----------
    rows, drive
        Averaged readings.
    found
        The sources.
    """
    sigma = np.sqrt(np.diag(found.covariance)).reshape(-1, 9)
    records = []
    for k, shape in enumerate(found.shapes):
        field, _ = shape.field_and_gradient(rows.points)
        strength = np.linalg.norm(field, axis=1)
        detected = strength > max(DETECTED_UT, DETECTED_SHARE * float(strength.max(initial=0.0)))
        away = np.linalg.norm(rows.points - shape.position, axis=1)
        passage = passages_of(drive.averages.slot, detected)
        others = rows.residual - found.field(rows.points) + field
        records.append(
            ChangedSource(
                position=shape.position,
                position_sigma=sigma[k, :3],
                moment=shape.moment,
                moment_sigma=sigma[k, 3:6],
                half_axis=shape.half_axis,
                gain=float(found.gains[k]),
                nearest=float(away.min()),
                strongest=float(strength.max()),
                passages=int(passage.max(initial=-1)) + 1,
                explanations=explanations(rows, drive, field, others, passage),
            )
        )
    return tuple(records)


def passages_of(slot: IntArray, detected: BoolArray) -> IntArray:
    """Return the passage of each reading, -1 where nothing is detected, shape (N,)."""
    slots = np.unique(slot[detected])
    number = np.concatenate([[0], np.cumsum(np.diff(slots) > APART)]) if len(slots) else slots
    passage = np.full(len(slot), -1)
    passage[detected] = number[np.searchsorted(slots, slot[detected])]
    return passage


def explanations(
    rows: MarginalRows,
    drive: AveragedDrive,
    field: FloatArray,
    residual: FloatArray,
    passage: IntArray,
) -> tuple[CauseGain, ...]:
    """Return what each cause explains of residuals, the best first.

    Parameters
    ----------
    rows, drive
        Averaged readings, N of them.
    field
        Of the source at all of them in uT, shape (N, 3).
    residual
        What it has to explain in uT, shape (N, 3).
    passage
        Which passage each reading is of, -1 for none, shape (N,).
    """
    sensor = drive.view.readings.sensor
    by_passage = np.stack([passage == p for p in range(passage.max(initial=0) + 1)], axis=1)
    by_sensor = np.stack([sensor == s for s in np.unique(sensor)], axis=1)
    offsets = sensor_offsets(drive) * (passage >= 0)[:, None, None]
    pulled, _ = rows.pull(residual)
    per_passage = gains(rows, field[:, :, None] * by_passage[:, None], pulled, 1)
    per_sensor = gains(rows, field[:, :, None] * by_sensor[:, None], pulled, 1)
    own_offset = gains(rows, offsets, pulled, 3)
    size = float(np.sqrt(np.mean(np.sum(field[passage >= 0] ** 2, axis=1))))
    one = price(rows, 1)
    place = float(gains(rows, field[:, :, None], pulled, 1)[0]) - one
    moment = float(per_passage.max() - one - 2 * np.log(len(per_passage)))
    alone = max(float(per_sensor.max()) - one, float(own_offset.max()) - 3 * one)
    width = offsets.shape[2]
    vehicle = float(gains(rows, offsets, pulled, width)[0]) - width * one
    found = [
        CauseGain(Cause.PLACE, place, size),
        CauseGain(Cause.MOMENT, moment, size),
        CauseGain(Cause.VEHICLE, vehicle, size),
    ]
    if len(per_sensor) > 1:
        single = float(alone - 2 * np.log(len(per_sensor)))
        found.append(CauseGain(Cause.SENSOR, single, size))
    return tuple(sorted(found, key=lambda each: -each.gain))


def offset_gain(rows: MarginalRows, drive: AveragedDrive) -> float:
    """Return what offsets of the sensors explain, on wherever readings were rejected (a BIC).

    Something on the vehicle that is switched does that, alike at all places.
    """
    on = drive.averages.counted < REJECTED
    return _offsets_explain(rows, drive, on) if on.any() else 0.0


def vehicle_gain(rows: MarginalRows, drive: AveragedDrive) -> float:
    """Return what offsets of the sensors explain that are on all along a drive (a BIC)."""
    return _offsets_explain(rows, drive, np.ones(len(rows), dtype=np.bool_))


def _offsets_explain(rows: MarginalRows, drive: AveragedDrive, on: BoolArray) -> float:
    features = sensor_offsets(drive) * on[:, None, None]
    pulled, _ = rows.pull(rows.residual)
    width = features.shape[2]
    return float(gains(rows, features, pulled, width)[0]) - price(rows, width)


def sensor_offsets(drive: AveragedDrive) -> FloatArray:
    """Return what offsets of all S sensors do to readings, map frame, no unit, (N, 3, 3 S)."""
    readings, estimate = drive.view.readings, drive.estimate
    own = right_divided(readings.R_map_lidar, estimate.C()[readings.sensor])
    offsets = np.zeros((len(readings), 3, len(readings.sensors), 3))
    offsets[np.arange(len(readings)), :, readings.sensor] = own
    present = np.unique(readings.sensor)
    return np.asarray(offsets[:, :, present].reshape(len(readings), 3, -1))


def gains(rows: MarginalRows, features: FloatArray, pulled: FloatArray, width: int) -> FloatArray:
    """Return what so many columns of fields together explain, group by group.

    Parameters
    ----------
    rows
        Averaged readings, N of them.
    features
        Fields per unit, G groups of ``width``, shape (N, 3, G width).
    pulled
        The precision times what they have to explain, shape (N, 3).

    Returns
    -------
    numpy.ndarray
        Twice the logarithm of each group's likelihood ratio, if it may be of any strength, (G,).
    """
    F, g = rows.information(features), np.einsum("nim,ni->m", features, pulled)
    found = []
    for first in range(0, len(g), width):
        own = slice(first, first + width)
        x, *_ = np.linalg.lstsq(F[own, own], g[own], rcond=1e-10)
        found.append(float(g[own] @ x))
    return np.array(found)

"""Steel that a drive shows beside a map: what changed since the survey, and what that missed.

A map keeps the readings of its survey. Where it does not explain them, as where it takes a box for
floor, a drive differs from it as if steel had come. With e what the survey's readings lack of the
map, b the field of a source that a drive shows and sigma the noise of a reading,

    sum (|e|^2 - |e - b|^2) / sigma^2

is twice the logarithm of the likelihood that the source stood there already over that it did not:
neither has parameters that the other has not. Steel that came or went since leaves -sum |b|^2 /
sigma^2, and where a source is beyond reach of the survey nothing is said.

What else would explain such a source: is it of the place, of the moment, of the vehicle or of one
sensor? All four are amplitudes of known fields, compared by the likelihood of the same readings:

- place: the source's field, in all passages and at all sensors alike;
- moment: the same in one passage only;
- vehicle: an offset in the frame of each sensor, alike wherever it is on;
- sensor: the source's field, or such an offset, at one sensor only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import BoolArray, FloatArray, IntArray
from l2m_gtsam.maps.field_map import Surveyed
from l2m_gtsam.maps.sources.found_sources import FoundSources, price, refined
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import REACH_M, SourceSearchOptions, find_sources
from l2m_gtsam.maps.sources.source import SourceShape
from l2m_gtsam.records.places import CLEAR, Cause, CauseGain, ChangedSource
from l2m_gtsam.solve.linear_algebra import right_divided

DETECTED_UT = 0.2  # weaker a source is not detected, if it is stronger anywhere
DETECTED_SHARE = 0.2  # of its strongest field: where a passage begins and ends
APART = 30  # slots from one passage to the next
REJECTED = 0.5  # share of the readings of an average, from which it disagrees


@dataclass(frozen=True)
class DriveSources:
    """Sources that readings of a drive show beside a map.

    Attributes
    ----------
    rows, drive
        The readings; single wrong ones do not count.
    found
        K sources.
    missed
        Which of them the map's survey shows as well, shape (K,): they stood there already.
    """

    rows: MarginalRows
    drive: AveragedDrive
    found: FoundSources
    missed: BoolArray

    @property
    def gain(self) -> float:
        """What the sources explain, less what their parameters cost."""
        before = self.rows.pull(self.rows.residual)[1]
        return before - self.found.left - price(self.rows, self.found.parameters)

    @property
    def missed_places(self) -> FloatArray:
        """Where the map lacks steel, metres, shape (M, 3)."""
        return np.array([each.position for each in self.found.shapes])[self.missed]

    def changed(self) -> tuple[ChangedSource, ...]:
        """Return what came, went or was moved since the survey."""
        every = changed_sources(self.rows, self.drive, self.found)
        return tuple(each for each, was in zip(every, self.missed, strict=True) if not was)

    def of_changes(self) -> FoundSources:
        """Return the sources that changed, fitted without those that the map misses."""
        if not self.missed.any():
            return self.found
        pairs = zip(self.found.shapes, self.missed, strict=True)
        kept = refined(self.rows, tuple(shape for shape, was in pairs if not was))
        return replace(kept, gains=self.found.gains[~self.missed])


def drive_sources(
    rows: MarginalRows,
    drive: AveragedDrive,
    suspected: FloatArray,
    field_map: QueryableMap,
    options: SourceSearchOptions,
    known: FoundSources | None = None,
) -> DriveSources:
    """Return the sources that a drive shows.

    Parameters
    ----------
    rows, drive
        Its averaged readings.
    suspected
        Places near which sources may be, metres, shape (M, 3).
    field_map
        As it was surveyed.
    options
        How to look.
    known
        Sources that were found before, if any.
    """
    found = find_sources(rows, suspected, options, known)
    missed = missed_by_map(found.shapes, field_map)
    return DriveSources(rows.without(found.wrong), drive, found, missed)


def missed_by_map(shapes: Sequence[SourceShape], field_map: QueryableMap) -> BoolArray:
    """Return which sources the readings of a map's survey clearly show as well, shape (K,).

    None of a map that keeps no readings.

    Parameters
    ----------
    shapes
        Sources that a drive shows beside the map, K of them.
    field_map
        As it was surveyed.
    """
    if not shapes or not isinstance(field_map, Surveyed):
        return np.zeros(len(shapes), dtype=np.bool_)
    near = field_map.readings.tree.query_ball_point([each.position for each in shapes], REACH_M)
    read = field_map.readings[np.unique(np.concatenate([np.array(rows, int) for rows in near]))]
    if not len(read):
        return np.zeros(len(shapes), dtype=np.bool_)
    field, _ = field_map.field_and_gradient(read.points)
    lacking, weight = read.field - field, read.weight[:, None]
    variance = float(np.mean(weight * lacking**2))
    gains = []
    for shape in shapes:
        b, _ = shape.field_and_gradient(read.points)
        gains.append(float(np.sum(weight * b * (2 * lacking - b))))
    return np.array(gains) > CLEAR * variance


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
        strongest = float(strength.max())
        least = DETECTED_UT if strongest > DETECTED_UT else 0.0
        detected = strength > max(least, DETECTED_SHARE * strongest)
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
                strongest=strongest,
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
    place = amplitudes(rows, field[:, :, None], pulled)[0] - one
    moment = float(per_passage.max() - one - 2 * np.log(len(per_passage)))
    alone = max(float(per_sensor.max()) - one, float(own_offset.max()) - 3 * one)
    vehicle = amplitudes(rows, offsets, pulled)[0] - offsets.shape[2] * one
    found = [
        CauseGain(Cause.PLACE, place, size),
        CauseGain(Cause.MOMENT, moment, size),
        CauseGain(Cause.VEHICLE, vehicle, size),
    ]
    if len(per_sensor) > 1:
        single = float(alone - 2 * np.log(len(per_sensor)))
        found.append(CauseGain(Cause.SENSOR, single, size))
    return tuple(sorted(found, key=lambda each: -each.gain))


def offset_gain(rows: MarginalRows, drive: AveragedDrive, on: BoolArray) -> float:
    """Return what offsets of the sensors explain that are on at some readings, (N,) (a BIC)."""
    if not on.any():
        return 0.0
    features = sensor_offsets(drive) * on[:, None, None]
    pulled, _ = rows.pull(rows.residual)
    gain, offsets = amplitudes(rows, features, pulled)
    return gain - price(rows, len(offsets))


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
    groups = np.split(features, features.shape[2] // width, axis=2)
    return np.array([amplitudes(rows, each, pulled)[0] for each in groups])


def amplitudes(
    rows: MarginalRows, features: FloatArray, pulled: FloatArray
) -> tuple[float, FloatArray]:
    """Return the same of M fields that are one group, and their likeliest strengths, shape (M,)."""
    F, g = rows.information(features), np.einsum("nim,ni->m", features, pulled)
    x, *_ = np.linalg.lstsq(F, g, rcond=1e-10)
    return float(g @ x), x

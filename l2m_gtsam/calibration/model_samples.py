"""Readings of a solve as models of a sensor take them: beside what the map predicts."""

from collections.abc import Sequence

import numpy as np

from l2m_factors import PoseMotion, field_rate
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.trust import FEWEST
from l2m_gtsam.calibration.view import QueryableMap, places_of
from l2m_gtsam.data import FieldSample, FloatArray, IntArray, Readings
from l2m_gtsam.records.sensor_models import Samples
from l2m_gtsam.solve.robust import Loss, RobustOptions, consistent


def predicted(
    parts: Sequence[Readings], field_map: QueryableMap, estimate: Estimate
) -> list[FieldSample]:
    """Return what a map predicts for readings of one sensor each, at least one, part by part.

    The map is asked once: many places in a tile cost less than few many times.
    """
    if not parts:
        return []
    places = [places_of(part, estimate.t) for part in parts]
    sample = field_map.query(np.concatenate(places))
    ends = np.cumsum([len(place) for place in places])[:-1]
    columns = (sample.field, sample.gradient, sample.variance, sample.inside)
    return [FieldSample(*each) for each in zip(*(np.split(c, ends) for c in columns), strict=True)]


def model_samples(
    readings: Readings, sample: FieldSample, estimate: Estimate, names: tuple[str, ...]
) -> Samples:
    """Return readings of one sensor beside what the map predicts where an estimate puts it.

    Without motion the field's rates are zero, so that there is no model of eddy currents.

    Parameters
    ----------
    readings
        Of one sensor, at least one, in order of time; those outside the map do not count.
    sample
        What the map predicts for them; see ``predicted``.
    estimate
        Of its place and noise.
    names
        Of the readings' recorded numbers.
    """
    sensor = int(readings.sensor[0])
    t, noise = estimate.t[sensor], estimate.noise[sensor]
    inside = sample.inside
    readings, R_lidar_map = readings.select(inside), readings.R_map_lidar[inside].transpose(0, 2, 1)
    b = np.einsum("nij,nj->ni", R_lidar_map, sample.field[inside])
    slope = R_lidar_map @ sample.gradient[inside] @ readings.R_map_lidar
    q = np.empty((len(b), 0)) if readings.regressors is None else readings.regressors
    return Samples(
        z=readings.field,
        b=b,
        db_dt=_rates(readings, b, slope, t),
        q=q,
        weights=1 / (noise**2 + sample.variance[inside].mean(axis=1)),
        names=names,
        drive=readings.drive,
    )


def _rates(readings: Readings, b: FloatArray, slope: FloatArray, t: FloatArray) -> FloatArray:
    """Return db/dt in uT/s, shape (N, 3); zero where motion is not known."""
    if readings.motion is None:
        return np.zeros_like(b)
    motion = PoseMotion(readings.motion.twist_lidar, readings.motion.offset)
    return field_rate(b, slope, np.broadcast_to(t, b.shape), motion)


def explicable(samples: Samples, noise: float, options: RobustOptions) -> IntArray:
    """Return which readings one distortion and the recorded numbers explain, shape (n,).

    A solve that does not know of a motor may have rejected what its current explains.

    Parameters
    ----------
    samples
        All readings of a sensor inside the map.
    noise
        Of the sensor, as it counts in the weights, uT.
    options
        Of the loss; a squared one takes all readings.
    """
    if options.loss is Loss.SQUARED or len(samples) < FEWEST:
        return np.arange(len(samples))
    spread = samples.q.std(axis=0)
    columns = np.hstack([samples.b, samples.q / np.where(spread > 0, spread, 1.0)])
    variance = np.maximum(1 / samples.weights - noise**2, 0.0)
    return np.flatnonzero(consistent(columns, samples.z, variance, options.largest))

"""A drive of a vehicle whose calibration is known, beside a map."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive, averaged, with_calibration
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND
from l2m_gtsam.calibration.causes import changed_sources, vehicle_gain
from l2m_gtsam.calibration.changed_places import ChangesOptions, suspected
from l2m_gtsam.calibration.coverage import sigmas_hold
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.data import FloatArray, KnownSensor, Readings
from l2m_gtsam.maps.harmonic.harmonic_map import HarmonicMap
from l2m_gtsam.maps.sources.search import find_sources, price
from l2m_gtsam.records.places import ChangedSource

# Sensors are not known better than this, whatever is stated: metres, no unit, uT and seconds.
LEAST_SIGMA = np.array([1e-3] * 3 + [5e-4] * 9 + [0.02] * 3 + [1e-4])


@dataclass(frozen=True)
class SeenSources:
    """What a drive shows beside a map.

    Attributes
    ----------
    sources
        That came since, or went: those have the opposite of their moment.
    gain
        What they explain, less what their parameters cost.
    vehicle
        What other offsets of the sensors explain, alike all along the drive; likewise.
    """

    sources: tuple[ChangedSource, ...]
    gain: float
    vehicle: float


def estimate_of(known: Sequence[KnownSensor], noise: float) -> Estimate:
    """Return S known sensors, each with a noise in uT, as a solve has them."""
    return Estimate(
        t=np.stack([each.t_lidar_mag for each in known]),
        distortion=np.stack([each.distortion.vector() for each in known]),
        noise=np.full(len(known), noise),
        ridge=np.zeros(len(known)),
        offset=np.array([each.time_offset for each in known]),
    )


def seen_sources(
    readings: Readings,
    known: Sequence[KnownSensor],
    field_map: HarmonicMap,
    options: ChangesOptions,
) -> SeenSources:
    """Return the sources that explain what readings of known sensors differ from a map by.

    Parameters
    ----------
    readings
        With their poses at the sensors' time offsets.
    known
        The S sensors, in the readings' order.
    field_map
        The map.
    options
        How to look.
    """
    estimate = estimate_of(known, field_map.learnt.hyperparameters.noise)
    every = np.ones(len(readings), dtype=np.bool_)
    averages = averaged(readings, field_map, estimate, every, options.averaging)
    drive = AveragedDrive.of(averages, field_map, estimate)
    places = suspected(drive, field_map, options.averaging)
    # What a map misses that does not know its own errors is no change.
    if not len(places) or not sigmas_hold(field_map):
        return SeenSources((), 0.0, 0.0)
    free = drive.marginal(field_map, field_map, NOTHING_FOUND, options.averaging)
    rows = with_calibration(free, covariances(known))
    found = find_sources(rows, places, options.sources, None)
    gain = rows.pull(rows.residual)[1] - found.left - price(rows, found.parameters)
    return SeenSources(changed_sources(rows, drive, found), gain, vehicle_gain(rows, drive))


def covariances(known: Sequence[KnownSensor]) -> FloatArray:
    """Return how well sensors are known, shape (S, 16, 16)."""
    least = np.diag(LEAST_SIGMA**2)
    return np.stack(
        [least if each.covariance is None else each.covariance + least for each in known]
    )

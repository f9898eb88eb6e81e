"""The readings that a map covers at the current estimate, and what the map says about them."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.data import BoolArray, FieldSample, FloatArray, IntArray, Readings


class QueryableMap(Protocol):
    """What the solve asks of a map: the factors' view of it, and a query that knows its edge."""

    def field_and_gradient(self, points: FloatArray, /) -> tuple[FloatArray, FloatArray]:
        """Return field and gradient, smoothly extended beyond the data."""

    def query(self, points: FloatArray, /) -> FieldSample:
        """Return field, gradient, variance and whether the map has data there."""


@runtime_checkable
class Compilable(Protocol):
    """A map that has a faster form for solvers, equal to within far less than any noise."""

    def compile(self) -> QueryableMap:
        """Return that form."""


@dataclass(frozen=True)
class View:
    """Usable readings at an estimate.

    Attributes
    ----------
    readings
        The N readings of solvable sensors that lie inside the map.
    b_lidar
        Field that the map predicts there, in the lidar frame in uT, shape (N, 3).
    map_variance
        Its variance per axis of the map frame in uT^2, shape (N, 3).
    trust
        How far each counts, from 0 to 1, shape (N,).
    rows
        Which of all M readings these are, shape (N,).
    inside
        Which of all M readings lie inside the map, shape (M,).
    sensors
        Indices of the sensors that have enough readings inside the map.
    """

    readings: Readings
    b_lidar: FloatArray
    map_variance: FloatArray
    trust: FloatArray
    rows: IntArray
    inside: BoolArray
    sensors: list[int]


def places_of(readings: Readings, t: FloatArray) -> FloatArray:
    """Return where readings were taken in the map, metres, shape (N, 3).

    All that ask the map along a drive ask it at these very bits, so that it may remember them.

    Parameters
    ----------
    readings
        Of S sensors.
    t
        Where these are in the lidar frame in metres, shape (S, 3).
    """
    turned = np.einsum("nij,nj->ni", readings.R_map_lidar, t[readings.sensor])
    return np.asarray(turned + readings.p_map_lidar)


def observe(
    readings: Readings, field_map: QueryableMap, estimate: Estimate, min_readings: int
) -> View:
    """Ask the map at the estimated sensor positions, once for all sensors."""
    R = readings.R_map_lidar
    sample = field_map.query(places_of(readings, estimate.t))
    counts = np.bincount(readings.sensor[sample.inside], minlength=len(estimate.t))
    usable = counts >= min_readings
    keep = sample.inside & usable[readings.sensor]
    b_lidar = np.einsum("nji,nj->ni", R[keep], sample.field[keep])
    sensors = [int(s) for s in np.flatnonzero(usable)]
    return View(
        readings=readings.select(keep),
        b_lidar=b_lidar,
        map_variance=sample.variance[keep],
        trust=np.ones(int(keep.sum())),
        rows=np.flatnonzero(keep),
        inside=sample.inside,
        sensors=sensors,
    )

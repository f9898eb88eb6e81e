"""Whether the place changed or the vehicle: the same readings under both, by likelihood."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from l2m_gtsam.calibration.averaged_rows import AveragedDrive, averaged
from l2m_gtsam.calibration.budget.found import NOTHING_FOUND
from l2m_gtsam.calibration.causes import changed_sources
from l2m_gtsam.calibration.changed_places import ChangesOptions, suspected
from l2m_gtsam.calibration.coverage import UncertainMap, sigmas_hold
from l2m_gtsam.calibration.factor_graph import Estimate
from l2m_gtsam.calibration.sensor_columns import SENSOR
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray, LidarMotion, Readings
from l2m_gtsam.maps.sources.marginal import MarginalRows
from l2m_gtsam.maps.sources.search import FoundSources, find_sources, price, refined
from l2m_gtsam.records.places import CLEAR, ChangedSource

PLACE = "The place changed, not the vehicle"
VEHICLE = "The vehicle changed, not the place"
BOTH = "Both the place and the vehicle changed"


@dataclass(frozen=True)
class PlaceOrVehicle:
    """What explains readings that neither map nor calibration explain.

    Attributes
    ----------
    found, sources
        What changed at the place, if it did.
    gains
        Of each explanation over that of no change: twice the logarithm of the likelihood ratio,
        less what its parameters cost (the BIC).
    """

    found: FoundSources
    sources: tuple[ChangedSource, ...]
    gains: dict[str, float]

    @property
    def winner(self) -> str:
        """The explanation with the largest gain."""
        return max(self.gains, key=lambda each: self.gains[each])

    @property
    def of_place(self) -> bool:
        """Whether the place has changed by it."""
        return self.winner != VEHICLE

    @property
    def sentence(self) -> str:
        """What the readings say; a tie is called one."""
        ranked = sorted(self.gains, key=lambda each: -self.gains[each])
        figures = ", ".join(
            f"{each[0].lower()}{each[1:]}: {self.gains[each]:.0f}" for each in ranked
        )
        first, second = ranked[:2]
        head = f"{first}"
        if self.gains[first] - self.gains[second] < CLEAR:
            head = f"It cannot be told which: {first.lower()}, or {second.lower()}"
        return f"{head}, by the likelihood of the same readings ({figures})."


def place_or_vehicle(
    readings: Readings,
    field_map: QueryableMap,
    estimate: Estimate,
    covariances: FloatArray,
    parameters: int,
    options: ChangesOptions,
) -> PlaceOrVehicle | None:
    """Return what explains readings; none where no place is suspected, or no source stands out.

    Parameters
    ----------
    readings
        Of S sensors, inside the map, at their calibrated time offsets.
    field_map
        The map.
    estimate, covariances
        The calibration; covariances of t, C by row, H and time offset, finite, (S, 16, 16).
    parameters
        How many of the vehicle's have changed, as tested without a change of the place.
    options
        How to look for sources.
    """
    if not options.sources.most or not isinstance(field_map, UncertainMap):
        return None
    # What a map misses that does not know its own errors is no change.
    if not sigmas_hold(field_map):
        return None
    every = np.ones(len(readings), dtype=np.bool_)
    averages = averaged(readings, field_map, estimate, every, options.averaging)
    drive = AveragedDrive.of(averages, field_map, estimate)
    places = suspected(drive, field_map, options.averaging)
    if not len(places):
        return None
    free = drive.marginal(field_map, field_map, NOTHING_FOUND, options.averaging)
    found = find_sources(free, places, options.sources, None)
    if not len(found):
        return None
    held = with_calibration(free, covariances)
    unchanged = held.pull(held.residual)[1]
    at_place = refined(held, found.shapes)
    sources = price(free, found.parameters)
    vehicle = price(free, max(parameters, 1))
    gains = {
        PLACE: unchanged - at_place.left - sources,
        VEHICLE: unchanged - free.pull(free.residual)[1] - vehicle,
        BOTH: unchanged - found.left - sources - vehicle,
    }
    result = PlaceOrVehicle(found, (), gains)
    if result.winner == PLACE:
        found = replace(at_place, gains=found.gains)
    if result.of_place:
        return PlaceOrVehicle(found, changed_sources(free, drive, found), gains)
    return result


def together(parts: Sequence[Readings], names: tuple[str, ...]) -> Readings:
    """Return readings of single sensors as those of all."""
    counts = [len(each) for each in parts]

    def joined(values: Sequence[FloatArray | None]) -> FloatArray | None:
        known = [each for each in values if each is not None]
        return np.concatenate(known) if len(known) == len(parts) else None

    moving = [each.motion for each in parts]
    motion = None
    if all(each is not None for each in moving):
        motion = LidarMotion(
            np.concatenate([each.twist_lidar for each in moving if each is not None]),
            np.concatenate([each.offset for each in moving if each is not None]),
        )
    return Readings(
        sensors=names,
        sensor=np.repeat(np.arange(len(parts)), counts),
        stamp_ns=np.concatenate([each.stamp_ns for each in parts]),
        R_map_lidar=np.concatenate([each.R_map_lidar for each in parts]),
        p_map_lidar=np.concatenate([each.p_map_lidar for each in parts]),
        field=np.concatenate([each.field for each in parts]),
        motion=motion,
        pose_root=joined([each.pose_root for each in parts]),
    )


def with_calibration(rows: MarginalRows, covariances: FloatArray) -> MarginalRows:
    """Return rows whose sensors are as calibrated, to its covariances, shape (S, 16, 16)."""
    prior = rows.prior.copy()
    first = len(prior) - SENSOR * len(covariances)
    for k, covariance in enumerate(covariances):
        own = slice(first + SENSOR * k, first + SENSOR * (k + 1))
        sigma = np.sqrt(np.diag(covariance))
        scaled = covariance / np.outer(sigma, sigma)
        # Nearly singular where a calibration holds directions: as exact as a millionth of a sigma.
        values, axes = np.linalg.eigh(scaled)
        root = axes / np.sqrt(np.maximum(values, 1e-12))
        prior[own, own] = (root @ root.T) / np.outer(sigma, sigma)
    return replace(rows, prior=prior)

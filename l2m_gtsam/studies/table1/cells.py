"""The paper's Table I: errors of t, C and H over paths, noise levels, distortions and starts.

One survey of a warehouse gives the maps; its noise stays while that of the sensors to calibrate
changes, as the paper adds noise to these alone. Each cell is one drive: a path, a noise level and
a sensor of random place and distortion. Our full method runs from all starts. As it searches
around each start first, starts from which it finds the same place share one solve. The other
methods run from fewer starts on the first few drives of each path.
"""

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.alternation import OneKeyOptions
from l2m_gtsam.calibration.start.global_start import StartOptions
from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.options import Options
from l2m_gtsam.records.calibration import Uncertainty
from l2m_gtsam.simulate.route import RouteShape
from l2m_gtsam.simulate.scenario import ScenarioOptions
from l2m_gtsam.simulate.sensors import NoiseOptions, SamplingOptions, SensorArrayOptions
from l2m_gtsam.studies.json_arrays import JsonFloats
from l2m_gtsam.studies.methods import BLOCKS, MethodResult, cramer_rao, errors_of, one_key
from l2m_gtsam.studies.naive_peer import NaiveMap, NaiveOptions, naive_map, naive_peer
from l2m_gtsam.studies.site import SiteDrive, SiteOptions, SurveyedSite, random_drive, surveyed
from l2m_gtsam.studies.table1.methods import (
    HARMONIC,
    MAGYC,
    NAIVE,
    NO_MAP,
    OTHERS,
    OURS,
    SLIDING,
    THINNED,
    from_each,
    magyc,
)

DRIVE, STARTS = 1, 2  # streams of randomness


class Table1Options(Options):
    """Size and conditions of the study."""

    seed: int = Field(default=1, ge=0)
    """Of drives, sensors and starts; the site has its own."""
    noises: tuple[float, ...] = (0.1, 0.2, 0.5)
    """Of the sensors to calibrate, in microtesla."""
    paths: tuple[RouteShape, ...] = (
        RouteShape.CIRCLES,
        RouteShape.EIGHT,
        RouteShape.SERPENTINE,
        RouteShape.SLALOM,
        RouteShape.WANDER,
    )
    """Shapes of the drives; the rows of the paper's table in its order."""
    distortions: int = Field(default=50, ge=1)
    """Sensors of random place and distortion on each path at each noise, each on its own drive."""
    starts: int = Field(default=50, ge=1)
    """Of each sensor."""
    reach: float = Field(default=1.0, gt=0)
    """Starts are up to so many metres from the truth."""
    others: int = Field(default=3, ge=0)
    """On the first so many drives of each path and noise the other methods run, too."""
    other_starts: int = Field(default=1, ge=1)
    """From so many of their starts."""
    magyc: int = Field(default=0, ge=0)
    """On the first so many drives of each path and noise magyc runs, too, in an environment of its
    own (`make magyc`)."""
    bounds: int = Field(default=10, ge=1)
    """On the first so many drives of each path and noise the Cramer-Rao bound is computed."""
    site: SiteOptions = SiteOptions(
        scenario=ScenarioOptions(
            array=SensorArrayOptions(count=1),
            noise=NoiseOptions(field=0.05),
            calibration_sampling=SamplingOptions(field_rate=20.0),
        )
    )
    """World, survey and drives."""
    search: StartOptions = StartOptions()
    """One-key's search for its start."""
    solve: OneKeyOptions = OneKeyOptions(uncertainty=Uncertainty.INDEPENDENT)
    """How one-key solves: the table is of estimates, not of sigmas."""
    naive: NaiveOptions = NaiveOptions()
    """How much of the data the naive peer can bear."""


@dataclass(frozen=True)
class SurveyedWarehouse:
    """A surveyed warehouse.

    Attributes
    ----------
    maps
        Of the survey, by kind.
    naive
        What the naive peer makes of the survey, by the path that it was asked for.
    """

    site: SurveyedSite
    maps: dict[str, QueryableMap]
    naive: dict[int, NaiveMap] = field(default_factory=dict)

    def __reduce__(self) -> tuple[Any, ...]:
        # The naive peer's maps are fifty times as large as all others together.
        return SurveyedWarehouse, (self.site, self.maps)

    def naive_map(self, options: Table1Options, row: int) -> NaiveMap:
        """Return the naive peer's map around a path."""
        if row not in self.naive:
            # Always the same drive: a cell must not depend on those before it in its process.
            survey, first = self.site.survey, drive_of(options, self.site, 0, row, 0)
            line = first.readings.p_map_lidar
            self.naive[row] = naive_map(survey.points, survey.field, line, options.naive)
        return self.naive[row]


@dataclass(frozen=True)
class Ends:
    """Where one method ended on one drive from N starts.

    Attributes
    ----------
    t, C, H
        Norms of the errors, in metres, Frobenius, and microtesla; NaN without a result,
        shape (N,).
    seconds
        Of one core for each calibration.
    """

    method: str
    map_kind: str
    t: JsonFloats
    C: JsonFloats
    H: JsonFloats
    seconds: float


@dataclass(frozen=True)
class Table1Cell:
    """One drive.

    Attributes
    ----------
    noise
        In microtesla.
    path
        Its shape.
    places
        Distinct places from which one-key solved.
    bound
        Root of the bound's trace over t (m), C, and H (uT), shape (3,); empty where it was not
        computed.
    """

    noise: float
    path: RouteShape
    readings: int
    places: int
    bound: JsonFloats
    ends: tuple[Ends, ...]


def prepare(options: Table1Options) -> SurveyedWarehouse:
    """Survey the warehouse and make its maps."""
    site = surveyed(options.site)
    return SurveyedWarehouse(
        site, {kind: site.map(MapOptions(kind=kind)) for kind in (HARMONIC, SLIDING)}
    )


def compute(
    options: Table1Options, place: SurveyedWarehouse, level: int, row: int, number: int
) -> Table1Cell:
    """Calibrate the sensor of one drive by all methods.

    Parameters
    ----------
    level, row, number
        Which noise, which path, which of their drives.
    """
    noise, path = options.noises[level], options.paths[row]
    drive = drive_of(options, place.site, level, row, number)
    t_start = random_starts(options, drive.sensor.t_lidar_mag, [level, row, number])
    field_map = place.maps[HARMONIC]
    found = one_key(drive.readings, field_map, t_start, options.search, options.solve)
    ends = [ends_of(OURS, HARMONIC, drive, found)]
    if number < options.others:
        few = t_start[: options.other_starts]
        ends += other_ends(drive, place, few, options)
        peer_map = place.naive_map(options, row)
        solve = partial(naive_peer, drive.readings, peer_map, options.naive)
        ends.append(ends_of(NAIVE, THINNED, drive, from_each(solve, few)))
    if number < options.magyc:
        peer = magyc(drive.readings, drive.sensor.distortion.C)
        ends.append(ends_of(MAGYC, NO_MAP, drive, peer))
    bound = np.empty(0)
    if number < options.bounds:
        bound = drive_bound(drive, field_map, noise, options.solve)
    return Table1Cell(noise, path, len(drive.readings), found.solves, bound, tuple(ends))


def other_ends(
    drive: SiteDrive, place: SurveyedWarehouse, t_start: FloatArray, options: Table1Options
) -> list[Ends]:
    """Return where the paper's methods end on both maps, and ours on the paper's."""
    ends = [
        ends_of(name, kind, drive, from_each(partial(solve, drive.readings, field_map), t_start))
        for kind, field_map in place.maps.items()
        for name, solve in OTHERS.items()
    ]
    found = one_key(drive.readings, place.maps[SLIDING], t_start, options.search, options.solve)
    return [*ends, ends_of(OURS, SLIDING, drive, found)]


def ends_of(method: str, map_kind: str, drive: SiteDrive, found: MethodResult) -> Ends:
    """Return how far ends are from the truth."""
    t, C, H = errors_of(found.vector, drive.sensor).T
    return Ends(method, map_kind, t, C, H, found.seconds)


def drive_bound(
    drive: SiteDrive, field_map: QueryableMap, noise: float, options: OneKeyOptions
) -> FloatArray:
    """Return the root of the bound's trace over t, C and H, shape (3,)."""
    truth = np.append(drive.sensor.vector(), 0.0)  # clocks are right
    variance = np.diagonal(cramer_rao(drive.readings, field_map, truth, noise, options))
    return np.array([np.sqrt(variance[block].sum()) for block in BLOCKS])


def drive_of(
    options: Table1Options, site: SurveyedSite, level: int, row: int, number: int
) -> SiteDrive:
    """Return a drive; see ``compute``."""
    rng = np.random.default_rng([options.seed, level, row, number, DRIVE])
    chosen = drive_options(options, options.noises[level], options.paths[row])
    return random_drive(site, chosen, rng)


def drive_options(options: Table1Options, noise: float, path: RouteShape) -> SiteOptions:
    """Return the options of the drives of one path at one noise level."""
    scenario = options.site.scenario
    update = {
        "noise": scenario.noise.model_copy(update={"field": noise}),
        "calibration_route": scenario.calibration_route.model_copy(update={"shape": path}),
    }
    return options.site.model_copy(update={"scenario": scenario.model_copy(update=update)})


def random_starts(options: Table1Options, t_true: FloatArray, which: list[int]) -> FloatArray:
    """Return starts about the truth, shape (N, 3): any direction, any offset up to the reach."""
    rng = np.random.default_rng([options.seed, *which, STARTS])
    direction = rng.standard_normal((options.starts, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(t_true + options.reach * rng.uniform(size=(options.starts, 1)) * direction)

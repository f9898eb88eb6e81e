"""How well maps predict the field of extended bodies, and whether they know how well."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Protocol

import numpy as np

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FieldSample, FloatArray
from l2m_gtsam.maps.field_map import MapSummary
from l2m_gtsam.maps.training import TrainingSet
from l2m_gtsam.simulate.hall_drives import CLEARANCE_M, survey
from l2m_gtsam.simulate.steel_hall import (
    HALF_AREA,
    MILD,
    STRONG,
    SteelHall,
    steel_hall,
)
from l2m_gtsam.studies.statistics import inside_interval
from tests.worlds.hall_clouds import CloudVariant, hall_cloud

# Of a map's summary.
NOISE_FACT, VERDICT_FACT = "noise of a reading (uT)", "field"
DOUBT = "does not explain the field"


@dataclass(frozen=True)
class HeldOutField:
    """Places that no survey has read: points in metres and the true field in uT, (N, 3)."""

    points: FloatArray
    field: FloatArray


def held_out(
    hall: SteelHall, seed: int, span: tuple[float, float], count: int = 600
) -> HeldOutField:
    """Return random places between lanes and between these heights over the floor."""
    rng = np.random.default_rng([seed, 4])
    # More than half of the floor is free.
    xy = rng.uniform(-HALF_AREA, HALF_AREA, (3 * count, 2))
    xy = xy[hall.free(xy, CLEARANCE_M)][:count]
    points = np.column_stack([xy, rng.uniform(*span, len(xy))])
    return HeldOutField(points, hall.world.field(points))


@dataclass(frozen=True)
class Scene:
    """What a map is made of, and the truth for maps that are exact on purpose.

    Attributes
    ----------
    survey
        Readings.
    cloud
        What the LiDAR saw of the structures in metres, shape (P, 3); empty where nothing.
    hall
        The truth.
    """

    survey: TrainingSet
    cloud: FloatArray
    hall: SteelHall


class StudiedMap(QueryableMap, Protocol):
    """What the studies ask of a map."""

    @property
    def summary(self) -> MapSummary:
        """Figures of the map; its facts may hold NOISE_FACT and VERDICT_FACT."""
        ...


Build = Callable[[Scene], StudiedMap]


@dataclass(frozen=True)
class MapCase:
    """A kind of map under study.

    Attributes
    ----------
    build
        How it comes about.
    clouds
        Structure clouds it is tried with; a kind that knows no structure needs NONE alone.
    """

    build: Build
    clouds: tuple[CloudVariant, ...] = (CloudVariant.NONE,)


@dataclass(frozen=True)
class MapConditions:
    """Worlds and surveys of a study of maps.

    Attributes
    ----------
    worlds
        Seeds of hall and survey.
    strengths
        Factors on the polarisation of posts and racks.
    heights
        Passes of the surveys in metres, one tuple each.
    noise
        Of the surveys in uT.
    readings
        Of a survey.
    off_plane
        Places are held out this far above and below the passes too, in metres.
    """

    worlds: tuple[int, ...] = (0, 1, 2, 3)
    strengths: tuple[float, ...] = (MILD, STRONG)
    heights: tuple[tuple[float, ...], ...] = ((0.6,), (0.4, 0.9), (0.4, 0.7, 1.0))
    noise: float = 0.2
    readings: int = 1500
    off_plane: float = 0.0


@dataclass(frozen=True)
class Prediction:
    """Errors of one map at its held-out places.

    Attributes
    ----------
    error
        Map minus truth in uT where the map has data, shape (M, 3).
    sigma
        What the map said of it, shape (M, 3).
    z
        Their quotient, shape (M, 3).
    inside
        Share of the places where the map has data.
    noise
        Of a reading as the map estimates it in uT; NaN for a kind that does not.
    doubted
        Whether the map says that it does not explain the field.
    """

    error: FloatArray
    sigma: FloatArray
    z: FloatArray
    inside: float
    noise: float
    doubted: bool


@dataclass(frozen=True)
class MapRow:
    """A line of the table: one kind under one condition, over all worlds.

    Attributes
    ----------
    kind, cloud, strength, heights
        What was studied.
    rmse, sigma
        Of the error and as predicted, root mean square over axes and places, in uT.
    z_std, z_worst
        Standard deviation of all z-scores about zero, and of the world where it is farthest from
        one.
    coverage
        Of the 95 % interval per axis.
    inside
        Share of places inside the map.
    noise
        Of a reading as the maps estimate it, median over the worlds, in uT.
    doubted
        Share of the maps that say that they do not explain the field.
    """

    kind: str
    cloud: CloudVariant
    strength: float
    heights: tuple[float, ...]
    rmse: float
    sigma: float
    z_std: float
    z_worst: float
    coverage: float
    inside: float
    noise: float
    doubted: float

    def __str__(self) -> str:
        heights = "/".join(f"{height:g}" for height in self.heights)
        return (
            f"{self.kind:<16} {self.cloud:<21} {self.strength:>4g}  {heights:<12}"
            f" {self.rmse:7.3f} {self.sigma:7.3f} {self.z_std:6.2f} {self.z_worst:6.2f}"
            f" {self.coverage:6.3f} {self.inside:6.3f} {self.noise:6.3f}"
            f" {self.doubted:7.2f}"
        )


HEADER = (
    f"{'kind':<16} {'structure cloud':<21} {'steel':>4} {'heights (m)':<12}"
    f" {'rmse uT':>7} {'sigma':>7} {'z std':>6} {'worst':>6} {'cov95':>6} {'inside':>6}"
    f" {'noise':>6} {'doubted':>7}"
)


def map_study(
    cases: Mapping[str, MapCase],
    conditions: MapConditions,
    tell: Callable[[str], None] = print,
) -> tuple[MapRow, ...]:
    """Return a line for every kind, cloud, strength and set of heights, telling each at once.

    All kinds get the same surveys and are asked at the same places.
    """
    tell(HEADER)
    rows = []
    for (kind, cloud), strength, heights in product(
        _kinds(cases), conditions.strengths, conditions.heights
    ):
        build = cases[kind].build
        predictions = [
            predict(build, cloud, strength, heights, conditions, world)
            for world in conditions.worlds
        ]
        rows.append(_row(kind, cloud, strength, heights, predictions))
        tell(str(rows[-1]))
    return tuple(rows)


def predict(
    build: Build,
    cloud: CloudVariant,
    strength: float,
    heights: tuple[float, ...],
    conditions: MapConditions,
    world: int,
) -> Prediction:
    """Return the errors of the map of one survey."""
    hall = steel_hall(world, strength)
    surveyed = survey(hall, world, heights, conditions.noise, conditions.readings)
    field_map = build(Scene(surveyed, hall_cloud(hall, cloud, world), hall))
    low, high = min(heights), max(heights)
    truth = held_out(hall, world, (low - conditions.off_plane, high + conditions.off_plane))
    sample = field_map.query(truth.points)
    error = (sample.field - truth.field)[sample.inside]
    sigma = np.sqrt(sample.variance[sample.inside])
    facts = field_map.summary.facts
    return Prediction(
        error,
        sigma,
        z_scores(sample, truth.field),
        inside=float(sample.inside.mean()),
        noise=float(facts.get(NOISE_FACT, np.nan)),
        doubted=DOUBT in str(facts.get(VERDICT_FACT, "")),
    )


def z_scores(sample: FieldSample, truth: FloatArray) -> FloatArray:
    """Return (map - truth) / sigma per axis at the points inside the map, shape (M, 3).

    ``truth``, shape (N, 3), is the field without noise: a sample's variance has none.
    """
    z = (sample.field - truth) / np.sqrt(sample.variance)
    return np.asarray(z[sample.inside])


def _kinds(cases: Mapping[str, MapCase]) -> Iterator[tuple[str, CloudVariant]]:
    for kind, case in cases.items():
        for cloud in case.clouds:
            yield kind, cloud


def _row(
    kind: str,
    cloud: CloudVariant,
    strength: float,
    heights: tuple[float, ...],
    predictions: Sequence[Prediction],
) -> MapRow:
    """Return the figures over all worlds."""
    z = np.concatenate([p.z for p in predictions])
    stds = np.array([_rms(p.z) for p in predictions])
    return MapRow(
        kind,
        cloud,
        strength,
        heights,
        rmse=_rms(np.concatenate([p.error for p in predictions])),
        sigma=_rms(np.concatenate([p.sigma for p in predictions])),
        z_std=_rms(z),
        z_worst=float(stds[np.argmax(np.abs(np.log(stds)))]),
        coverage=float(inside_interval(z).mean()),
        inside=float(np.mean([p.inside for p in predictions])),
        noise=float(np.median([p.noise for p in predictions])),
        doubted=float(np.mean([p.doubted for p in predictions])),
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))

"""A part of a map as a picture, beside the truth, and how wrong the map is along drives."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from l2m_gtsam.calibration.view import QueryableMap
from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.world import SteelWorld
from l2m_gtsam.studies.json_arrays import Packed
from l2m_gtsam.studies.site import SiteDrive, SurveyedSite


class WindowOptions(Options):
    """The part of the floor that is drawn, around where the drive starts; lengths in metres."""

    width: float = Field(default=8.0, gt=0)
    """Along x."""
    height: float = Field(default=6.0, gt=0)
    """Along y."""
    step: float = Field(default=0.1, gt=0)
    """Between two points of the picture."""


@dataclass(frozen=True)
class MapImage:
    """A map at one height, and what it is worth.

    Attributes
    ----------
    extent
        Left, right, bottom and top of the picture in metres.
    z
        Its height in metres.
    strength
        Strength of the map's field in uT, NaN where it has no data, shape (rows, columns).
    truth
        That of the world, NaN within steel, shape (rows, columns).
    fingerprints
        x and y in metres of those within the picture, shape (F, 2).
    readings
        Fingerprints that the map is made of.
    per_m2
        As many lie on a square metre of surveyed floor, all heights together.
    rmse
        Root mean square of the field's error per axis in uT, where sensors pass.
    sigma
        The map's own prediction of that, in uT.
    inside
        Share of the drives' readings that lie in the map.
    """

    extent: tuple[float, float, float, float]
    z: float
    strength: Packed
    truth: Packed
    fingerprints: Packed
    readings: int
    per_m2: float
    rmse: float
    sigma: float
    inside: float


def map_image(
    field_map: QueryableMap,
    part: SurveyedSite,
    floor: float,
    drives: tuple[SiteDrive, ...],
    options: WindowOptions,
) -> MapImage:
    """Return a picture of a map of a survey, and how wrong it is where sensors pass.

    Parameters
    ----------
    part
        World, and the fingerprints of which the map is made.
    floor
        That the survey covers, in square metres.
    drives
        Of the sensors.
    options
        The part that is drawn.
    """
    start, survey = drives[0].readings.p_map_lidar[0], part.survey.points
    x, y = (
        middle + np.arange(-extent / 2, extent / 2 + options.step / 2, options.step)
        for middle, extent in ((start[0], options.width), (start[1], options.height))
    )
    z, half = float(survey[:, 2].min() + survey[:, 2].max()) / 2, (x[1] - x[0]) / 2
    ends = (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)
    left, right, bottom, top = (round(float(end), 6) for end in ends)
    points = np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z)], axis=-1).reshape(-1, 3)
    shown = np.all((survey[:, :2] > [left, bottom]) & (survey[:, :2] < [right, top]), axis=1)

    def image(field: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(field, axis=1).reshape(len(y), len(x)))

    places = np.concatenate([sensor_places(each) for each in drives])
    sample = field_map.query(places)
    inside = sample.inside
    off = sample.field[inside] - part.world.field(places[inside])
    return MapImage(
        extent=(left, right, bottom, top),
        z=z,
        strength=image(field_map.query(points).field),
        truth=image(field_outside(part.world, points)),
        fingerprints=survey[shown, :2],
        readings=len(part.survey),
        per_m2=len(part.survey) / floor,
        rmse=float(np.sqrt(np.mean(off**2))),
        sigma=float(np.sqrt(np.mean(sample.variance[inside]))),
        inside=float(np.mean(inside)),
    )


def sensor_places(drive: SiteDrive) -> FloatArray:
    """Return where the sensor of a drive was in the map frame in metres, shape (N, 3)."""
    readings = drive.readings
    return np.asarray(readings.R_map_lidar @ drive.sensor.t_lidar_mag + readings.p_map_lidar)


def field_outside(world: SteelWorld, points: FloatArray) -> FloatArray:
    """Return the field at points, shape (N, 3), in uT, NaN within steel."""
    return np.where(world.inside(points)[:, None], np.nan, world.field(points))

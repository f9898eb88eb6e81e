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


@dataclass(frozen=True)
class ImageWindow:
    """Points of a picture.

    Attributes
    ----------
    x, y
        Of columns and rows in metres, ascending, shapes (C,) and (R,).
    z
        Height in metres.
    """

    x: FloatArray
    y: FloatArray
    z: float

    @property
    def points(self) -> FloatArray:
        """In the map frame in metres, row by row, shape (R C, 3)."""
        x, y = np.meshgrid(self.x, self.y)
        return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, self.z)])

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top in metres, up to half a step beyond the points."""
        half = (self.x[1] - self.x[0]) / 2
        ends = (self.x[0] - half, self.x[-1] + half, self.y[0] - half, self.y[-1] + half)
        left, right, bottom, top = (round(float(end), 6) for end in ends)
        return left, right, bottom, top

    def image(self, values: FloatArray) -> FloatArray:
        """Return the strength of fields at the points, shape (R C, 3), as rows and columns."""
        return np.asarray(np.linalg.norm(values, axis=1).reshape(len(self.y), len(self.x)))

    def within(self, points: FloatArray) -> FloatArray:
        """Return x and y of those of the points, shape (N, 3), that it shows, shape (F, 2)."""
        left, right, bottom, top = self.extent
        x, y = points[:, 0], points[:, 1]
        return points[(x > left) & (x < right) & (y > bottom) & (y < top), :2]


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
    window = window_around(drives[0].readings.p_map_lidar[0], part.survey.points, options)
    places = np.concatenate([sensor_places(each) for each in drives])
    sample = field_map.query(places)
    inside = sample.inside
    off = sample.field[inside] - part.world.field(places[inside])
    return MapImage(
        extent=window.extent,
        z=window.z,
        strength=window.image(field_map.query(window.points).field),
        truth=window.image(field_outside(part.world, window.points)),
        fingerprints=window.within(part.survey.points),
        readings=len(part.survey),
        per_m2=len(part.survey) / floor,
        rmse=float(np.sqrt(np.mean(off**2))),
        sigma=float(np.sqrt(np.mean(sample.variance[inside]))),
        inside=float(np.mean(inside)),
    )


def window_around(centre: FloatArray, survey: FloatArray, options: WindowOptions) -> ImageWindow:
    """Return a window about a place (3,) in metres, in the middle of the survey's heights."""
    x, y = (
        centre[axis] + np.arange(-extent / 2, extent / 2 + options.step / 2, options.step)
        for axis, extent in enumerate((options.width, options.height))
    )
    return ImageWindow(x, y, float(survey[:, 2].min() + survey[:, 2].max()) / 2)


def sensor_places(drive: SiteDrive) -> FloatArray:
    """Return where the sensor of a drive was in the map frame in metres, shape (N, 3)."""
    readings = drive.readings
    return np.asarray(readings.R_map_lidar @ drive.sensor.t_lidar_mag + readings.p_map_lidar)


def field_outside(world: SteelWorld, points: FloatArray) -> FloatArray:
    """Return the field at points, shape (N, 3), in uT, NaN within steel."""
    return np.where(world.inside(points)[:, None], np.nan, world.field(points))

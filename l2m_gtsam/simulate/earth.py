"""The Earth's magnetic field at a place and a date."""

import datetime as dt
from typing import Annotated

import numpy as np
import ppigrf
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options

MICROTESLA_PER_NANOTESLA = 1e-3
METRES_PER_KILOMETRE = 1e3
# What the reference field's coefficients cover.
FIRST_DAY, LAST_DAY = dt.date(1900, 1, 1), dt.date(2029, 12, 31)


class EarthOptions(Options):
    """Where and when the warehouse stands, and how its map lies on the ground."""

    latitude: Annotated[float, Field(ge=-90, le=90)] = 1.3483
    """Geodetic latitude in degrees, north positive. The default is in Singapore."""
    longitude: Annotated[float, Field(ge=-180, le=180)] = 103.6831
    """Longitude in degrees, east positive."""
    altitude: Annotated[float, Field(ge=-500, le=9000)] = 20.0
    """Height above the ellipsoid in metres."""
    date: Annotated[dt.date, Field(ge=FIRST_DAY, le=LAST_DAY)] = dt.date(2025, 6, 1)
    """Day of the drives; the reference field's coefficients cover 1900 to 2029."""
    x_axis_azimuth: float = 90.0
    """Direction of the map's x axis, in degrees clockwise from north; 90 is x east, y north."""


def earth_field(options: EarthOptions) -> FloatArray:
    """Return the Earth's field in the map frame (z up) in microtesla, shape (3,).

    The International Geomagnetic Reference Field (Alken et al., Earth Planets Space 73:49,
    2021) as computed by `ppigrf`, which gives nanotesla along east, north and up.
    """
    east, north, up = (
        float(np.squeeze(component)) * MICROTESLA_PER_NANOTESLA
        for component in ppigrf.igrf(
            options.longitude,
            options.latitude,
            options.altitude / METRES_PER_KILOMETRE,
            dt.datetime.combine(options.date, dt.time()),
        )
    )
    azimuth = np.deg2rad(options.x_axis_azimuth)
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    return np.array([east * sin + north * cos, north * sin - east * cos, up])

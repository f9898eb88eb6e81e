"""Size of the validation study, and what changes in it between calibration and drive."""

from enum import StrEnum

from pydantic import Field

from l2m_gtsam.maps.build import MapOptions
from l2m_gtsam.options import Options


class TrueCause(StrEnum):
    """What changed since the calibration."""

    NOTHING = "nothing"
    """Nothing."""
    PLACE = "place"
    """Steel was brought beside the path."""
    TURNED = "turned"
    """The mount of all sensors was turned."""
    IRON = "iron"
    """Iron on the vehicle: hard iron at all sensors."""
    BOTH = "both"
    """Steel beside the path, and iron on the vehicle."""
    SENSOR = "sensor"
    """One sensor was turned in its place."""


class ValidationStudyOptions(Options):
    """Size and conditions of the study."""

    seed: int = Field(default=900, ge=0)
    """Of the first hall; the others follow it one by one."""
    halls: int = Field(default=20, ge=1)
    """Each with its map, its vehicle and its calibration."""
    cases: int = Field(default=2, ge=0)
    """Drives of a hall, each with the next of all changes."""
    unchanged: int = Field(default=3, ge=0)
    """Drives of a hall on which nothing has changed."""
    sensors: int = Field(default=3, ge=1)
    """Of a vehicle, at random places and with random distortions."""
    noise: float = Field(default=0.2, gt=0)
    """Of survey and drives alike in uT."""
    readings: int = Field(default=600, ge=100)
    """Of each sensor of a drive."""
    heights: tuple[float, ...] = Field(default=(0.4, 0.7, 1.0), min_length=1)
    """Passes of a survey over the floor in metres; sensors sit between them."""
    survey_readings: int = Field(default=1500, ge=30)
    """Of a survey."""
    moment: tuple[float, float] = (10.0, 50.0)
    """Of the steel that is brought, from and to in A m^2."""
    distance: tuple[float, float] = (0.5, 1.0)
    """Of it from the path of the sensors in metres."""
    edges: tuple[float, float, float] = (0.3, 0.3, 0.8)
    """Its length along each axis in metres."""
    turn_deg: tuple[float, float] = (1.0, 4.0)
    """By how much a mount, or one sensor, is turned about a random axis."""
    iron_ut: tuple[float, float] = (1.0, 5.0)
    """Size of the vehicle's new hard iron at each sensor, in a random direction."""
    map: MapOptions = MapOptions()
    """How the map is made of the survey, and of the structure that the LiDAR saw."""

"""Size and conditions of the study of places that change."""

from pydantic import Field

from l2m_gtsam.studies.validation.options import ValidationStudyOptions


class ChangesStudyOptions(ValidationStudyOptions):
    """Size and conditions of the study."""

    seed: int = Field(default=1200, ge=0)
    """Of the first hall; the others follow it one by one."""
    paths: int = Field(default=2, ge=1, le=2)
    """Through each hall, each driven with and without changes."""
    sensors: int = Field(default=2, ge=1)
    """Of a vehicle, at random places and with random distortions."""
    moment: tuple[float, float] = (1.0, 50.0)
    """Of steel that comes or goes, from and to in A m^2."""
    edges: tuple[float, float, float] = (0.2, 0.2, 0.2)
    """Its length along each axis in metres."""
    heights_of_steel: tuple[float, float] = (0.2, 2.0)
    """Over the floor, from and to in metres."""
    beyond: tuple[float, float] = (0.3, 2.5)
    """Of steel outside of the area: over its border, from and to in metres."""

"""How finely the map's error over a drive is resolved."""

from pydantic import Field

from l2m_gtsam.options import Options


class ErrorOptions(Options):
    """How finely the map's error is resolved."""

    places: int = Field(default=100, ge=10)
    """The most places of a tile that its modes are chosen at, spread over the drive."""
    rest: float = Field(default=0.02, gt=0, lt=1)
    """Share of the map's variance at these places that may stay without correlation."""

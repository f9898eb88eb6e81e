"""What the harmonic map learns from its readings: scales and depths of the sources, and noise."""

from pydantic import Field

from l2m_gtsam.options import Options


class Hyperparameters(Options):
    """Scales of the prior; learnt by the marginal likelihood, for the map and again for each tile.

    The depth of a side is the distance of its sources below the lowest, or above the highest,
    reading; its scale is the standard deviation of their horizontal field there per axis (the
    vertical one is larger by the square root of two).
    """

    floor_scale: float = Field(default=5.0, gt=0)
    """Microtesla."""
    floor_depth: float = Field(default=0.6, gt=0)
    """Metres."""
    ceiling_scale: float = Field(default=1.0, gt=0)
    """Microtesla."""
    ceiling_depth: float = Field(default=2.0, gt=0)
    """Metres."""
    structure_scale: float = Field(default=0.3, gt=0)
    """Standard deviation of each component of a source's moment, in uT m^3: a source of 1 uT m^3
    makes 1-2 uT at a metre."""
    noise: float = Field(default=0.2, gt=0)
    """Standard deviation of a reading per axis in microtesla."""


BOUNDS = {
    "floor_scale": (1e-3, 1e4),
    "floor_depth": (0.03, 30.0),
    "ceiling_scale": (1e-3, 1e4),
    "ceiling_depth": (0.03, 30.0),
    "structure_scale": (1e-5, 1e3),
    "noise": (1e-4, 1e2),
}
"""Where learning looks, in the units above."""

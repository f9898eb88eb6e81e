"""What is an outlier among the drives of a vehicle, and what the fleet's page shows."""

from pydantic import Field, PositiveFloat

from l2m_gtsam.options import Options


class FleetOptions(Options):
    """Thresholds and size of the fleet's page."""

    outlier: PositiveFloat = 5.0
    """How many times further than expected a parameter must be from the median of the vehicle's
    drives to be marked: both in standard deviations of the difference and in standard deviations
    of the drives' spread (1.4826 times their median absolute deviation)."""
    drives: int = Field(default=4, ge=3)
    """Drives of a vehicle that know the parameter, below which nothing is marked: of two that
    differ none is the outlier, and of three the spread is hardly known."""
    least_m: float = Field(default=0.003, ge=0)
    """Positions that are closer than this to the median are never marked, metres."""
    least_deg: float = Field(default=0.2, ge=0)
    """The same for rotations, degrees."""
    least_ut: float = Field(default=0.3, ge=0)
    """The same for H, microtesla."""
    pictures: int = Field(default=60, ge=0)
    """Most trends that the page draws, those with outliers first: it stays small and quick."""

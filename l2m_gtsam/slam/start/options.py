"""How the start of a drive is looked for all over a map."""

from pydantic import Field

from l2m_gtsam.options import Options


class StartSearchOptions(Options):
    """How the start of a drive is looked for all over a map."""

    window_m: float = Field(default=8.0, gt=0)
    """Way of the drive that is looked at first. It is doubled until the start is unique,"""
    longest_m: float = Field(default=32.0, gt=0)
    """up to this, or to the end of the drive: over more, odometry's errors blur what is compared.
    """
    readings: int = Field(default=80, ge=10, le=400)
    """The most readings of a window that take part, spread over its way."""
    least_readings: int = Field(default=16, ge=6)
    """Fewer readings tell no place: among thousands of places one explains them by chance."""
    step_m: float = Field(default=0.2, ge=0.05, le=1)
    """Of the lattice of places in the map; headings are as far apart as moves the outermost reading
    by a step. The field of a building varies over about three times that."""
    height_m: float | None = None
    """Height of the lidar in the map where the drive begins, within `position_m`; looked for over
    all heights that the map has data for if not given."""
    outliers: float = Field(default=0.15, ge=0, lt=0.5)
    """Share of the readings that may be wrong without a place being ruled out."""
    seeds: int = Field(default=150, ge=10, le=2000)
    """The most places of the lattice that are followed to their minima,"""
    candidates: int = Field(default=8, ge=2, le=50)
    """and the most minima whose likelihoods are compared."""
    apart_m: float = Field(default=0.3, gt=0)
    """Minima closer than this,"""
    apart_deg: float = Field(default=10.0, gt=0, le=180)
    """and than this in rotation, are one place."""
    clear: float = Field(default=10.0, gt=0)
    """The start is unique if the second best place is less likely than the best by this factor's
    natural logarithm; 10 are odds of 22,000 to 1."""
    least_inside: float = Field(default=0.4, gt=0, le=1)
    """A place where the map has data for a smaller share of the readings does not count."""
    least_explained: float = Field(default=0.7, gt=0, le=1)
    """One that explains a smaller share of these is not where the drive was,"""
    largest_chi2: float = Field(default=2.0, gt=1)
    """nor is one that leaves more than so many times the variance of what is known to be wrong: on
    the recorded drives true places leave 0.2 to 1.7, a false one 2.2."""

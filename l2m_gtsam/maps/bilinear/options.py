"""Options of the bilinear map."""

from pydantic import Field

from l2m_gtsam.options import Options


class BilinearOptions(Options):
    """Options of the grid; lengths are in metres."""

    spacing: float = Field(default=0.25, ge=0.01)
    """Distance of the nodes along x and y."""

    layer: float = Field(default=0.25, ge=0.01)
    """Distance of the layers that readings at several heights are sorted into, about: the height
    of a layer is the mean of its readings, and layers closer than half of this are one."""

    reach: float = Field(default=0.5, gt=0)
    """A point is inside the map when the average of some cell is this near; nodes without data
    of their layer within this, and a cell's diagonal, take the nearest average of all."""

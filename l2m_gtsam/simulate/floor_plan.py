"""The floor of a warehouse: where racks stand and where a vehicle can drive."""

from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options

NARROWEST_AISLE = 1.6
"""Least width in metres that leaves a vehicle with its sensors room to drive."""


class FloorPlanOptions(Options):
    """Sizes of the hall and of the racks in it."""

    length: Annotated[float, Field(gt=0)] = 45.0
    """Extent of the hall along the map's x axis, in metres."""
    width: Annotated[float, Field(gt=0)] = 35.0
    """Extent of the hall along the map's y axis, in metres."""
    rack_rows: Annotated[int, Field(ge=1)] = 6
    """Double rows of racks, parallel to x; aisles lie between them and along both walls."""
    rack_depth: Annotated[float, Field(gt=0)] = 2.4
    """Depth of one double row, in metres."""
    blocks: Annotated[int, Field(ge=1)] = 2
    """Blocks into which each row is cut; cross aisles lie between them and at both ends."""
    cross_aisle: Annotated[float, Field(ge=NARROWEST_AISLE)] = 4.2
    """Width of a cross aisle, in metres."""

    @model_validator(mode="after")
    def _leave_room(self) -> Self:
        aisle, block = _aisle_width(self), _block_length(self)
        if aisle < NARROWEST_AISLE:
            raise ValueError(
                f"rack_rows: {self.rack_rows} rows of {self.rack_depth} m leave aisles of "
                f"{aisle:.2f} m in a hall {self.width} m wide, at least {NARROWEST_AISLE} m are "
                "needed"
            )
        if block <= 0:
            raise ValueError(
                f"blocks: {self.blocks + 1} cross aisles of {self.cross_aisle} m leave no room "
                f"for racks in a hall {self.length} m long"
            )
        return self


@dataclass(frozen=True)
class FloorPlan:
    """Racks and aisles of a hall whose corner is the map's origin.

    Attributes
    ----------
    length, width
        Extents along x and y in metres.
    aisle_y
        Centre lines of the aisles along x, ascending, in metres, shape (rows + 1,).
    aisle_width
        Width of each of them in metres.
    cross_x
        Centre lines of the cross aisles along y, ascending, in metres, shape (blocks + 1,).
    cross_width
        Width of each of them in metres.
    rack_y
        Lower and upper edge of each row of racks in metres, shape (rows, 2).
    block_x
        Lower and upper edge of each block of racks in metres, shape (blocks, 2).
    """

    length: float
    width: float
    aisle_y: FloatArray
    aisle_width: float
    cross_x: FloatArray
    cross_width: float
    rack_y: FloatArray
    block_x: FloatArray


def plan_floor(options: FloorPlanOptions) -> FloorPlan:
    """Return the floor plan that these options describe."""
    aisle, block = _aisle_width(options), _block_length(options)
    aisle_low = np.arange(options.rack_rows + 1) * (aisle + options.rack_depth)
    cross_low = np.arange(options.blocks + 1) * (options.cross_aisle + block)
    rack_low = aisle_low[:-1] + aisle
    block_low = cross_low[:-1] + options.cross_aisle
    return FloorPlan(
        length=options.length,
        width=options.width,
        aisle_y=np.asarray(aisle_low + aisle / 2),
        aisle_width=aisle,
        cross_x=np.asarray(cross_low + options.cross_aisle / 2),
        cross_width=options.cross_aisle,
        rack_y=np.column_stack([rack_low, rack_low + options.rack_depth]),
        block_x=np.column_stack([block_low, block_low + block]),
    )


def _aisle_width(options: FloorPlanOptions) -> float:
    return (options.width - options.rack_rows * options.rack_depth) / (options.rack_rows + 1)


def _block_length(options: FloorPlanOptions) -> float:
    return (options.length - (options.blocks + 1) * options.cross_aisle) / options.blocks

"""Parts of steel: boxes of one section each, row by row."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options


class SectionOptions(Options):
    """The cross section of one kind of steel part, as a homogeneous box."""

    breadth: Annotated[float, Field(gt=0)]
    """Outer side of the section in metres."""
    height: Annotated[float, Field(gt=0)]
    """The other outer side in metres."""
    fill: Annotated[float, Field(gt=0, le=1)]
    """Share of the outer section that is steel: rolled and folded sections are mostly air."""


@dataclass(frozen=True)
class Parts:
    """Parts of one kind: boxes along x, y and z, turned about z.

    Attributes
    ----------
    kind
        What they are.
    fill
        Share of their outer section that is steel.
    dimensions, centres
        In metres, shape (N, 3).
    yaw
        In radians, shape (N,).
    """

    kind: str
    fill: float
    dimensions: FloatArray
    centres: FloatArray
    yaw: FloatArray


def alike(
    kind: str, section: SectionOptions, size: tuple[float, float, float], centres: FloatArray
) -> Parts:
    """Return parts of one size that stand along the hall's axes."""
    count = len(centres)
    return Parts(kind, section.fill, np.tile(size, (count, 1)), centres, np.zeros(count))


def spread(low: float, high: float, pitch: float) -> FloatArray:
    """Return evenly spaced places from ``low`` to ``high``, at most ``pitch`` apart."""
    # Rounding of the edges must not add a part where the pitch divides the length.
    return np.linspace(low, high, int(np.ceil((high - low) / pitch - 1e-9)) + 1)


def cells(extent: float, pitch: float) -> FloatArray:
    """Return the centres of equal cells of about ``pitch`` that fill ``extent``."""
    count = max(1, round(extent / pitch))
    return (np.arange(count) + 0.5) * extent / count


def grid(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return all pairs of x and y, shape (len(x) * len(y), 2)."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

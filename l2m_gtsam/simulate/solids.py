"""Solid boxes: all that light meets in a simulated world."""

from dataclasses import dataclass
from itertools import product
from typing import Self

import numpy as np

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.simulate.world import SteelWorld

# Corners are numbered by the bits of x, y and z, x first; every face is two triangles of them.
CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
TRIANGLES = np.array(
    [
        [[0, 1, 3], [0, 3, 2]],
        [[4, 6, 7], [4, 7, 5]],
        [[0, 4, 5], [0, 5, 1]],
        [[2, 3, 7], [2, 7, 6]],
        [[0, 2, 6], [0, 6, 4]],
        [[1, 5, 7], [1, 7, 3]],
    ]
).reshape(-1, 3)


@dataclass(frozen=True)
class Solids:
    """Boxes in the map; a room is one that is seen from within.

    Attributes
    ----------
    dimensions
        Lengths of the sides along a box's own axes in metres, shape (N, 3).
    centres
        In the map in metres, shape (N, 3).
    R_map_body
        Rotations from box to map, shape (N, 3, 3).
    """

    dimensions: FloatArray
    centres: FloatArray
    R_map_body: FloatArray

    def __len__(self) -> int:
        return len(self.dimensions)

    @classmethod
    def spanned(cls, low: FloatArray, high: FloatArray) -> Self:
        """Return boxes along the map's axes from lowest to highest corners, shapes (N, 3)."""
        low, high = np.reshape(low, (-1, 3)), np.reshape(high, (-1, 3))
        return cls(high - low, (low + high) / 2, np.tile(np.eye(3), (len(low), 1, 1)))

    @classmethod
    def of(cls, world: SteelWorld) -> Self:
        """Return the bodies of a world as light meets them."""
        return cls(world.dimensions, world.centres, world.R_map_body)

    def joined(self, other: "Solids") -> "Solids":
        """Return these boxes and others."""
        return Solids(
            np.concatenate([self.dimensions, other.dimensions]),
            np.concatenate([self.centres, other.centres]),
            np.concatenate([self.R_map_body, other.R_map_body]),
        )

    def vertices(self) -> FloatArray:
        """Return the corners of all boxes in the map in metres, shape (8 N, 3)."""
        own = CORNERS * self.dimensions[:, None]
        turned = np.einsum("nij,ncj->nci", self.R_map_body, own)
        return np.asarray((turned + self.centres[:, None]).reshape(-1, 3))

    def triangles(self) -> IntArray:
        """Return the triangles of all faces as rows of ``vertices``, outwards, shape (12 N, 3)."""
        first = len(CORNERS) * np.arange(len(self))
        return np.asarray((TRIANGLES + first[:, None, None]).reshape(-1, 3))

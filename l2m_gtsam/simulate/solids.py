"""Solid boxes: all that light meets in a simulated world."""

from dataclasses import dataclass
from itertools import product
from typing import Annotated, Self

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray, IntArray
from l2m_gtsam.options import Options
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

    def vertices(self) -> FloatArray:
        """Return the corners of all boxes in the map in metres, shape (8 N, 3)."""
        own = CORNERS * self.dimensions[:, None]
        turned = np.einsum("nij,ncj->nci", self.R_map_body, own)
        return np.asarray((turned + self.centres[:, None]).reshape(-1, 3))

    def triangles(self) -> IntArray:
        """Return the triangles of all faces as rows of ``vertices``, outwards, shape (12 N, 3)."""
        first = len(CORNERS) * np.arange(len(self))
        return np.asarray((TRIANGLES + first[:, None, None]).reshape(-1, 3))


class StructureCloudOptions(Options):
    """How densely and how well the steel is seen."""

    spacing: Annotated[float, Field(ge=0.01)] = 0.05
    """Largest distance of neighbouring points on a surface in metres."""
    height: Annotated[float, Field(gt=0)] = 4.0
    """Height above the floor up to which surfaces are seen, in metres."""
    noise: Annotated[float, Field(ge=0)] = 0.01
    """Standard deviation of a point along each axis in metres."""


def structure_cloud(
    world: SteelWorld | Solids, options: StructureCloudOptions, rng: np.random.Generator
) -> FloatArray:
    """Return points on the surfaces of all bodies, as far as these are above the floor.

    Nothing hides anything: a hall is mapped from many places. What is buried, such as rebar and
    floor beams, is not seen.

    Parameters
    ----------
    world
        Bodies over the floor, z = 0.
    options
        Which points are seen, and how well.

    Returns
    -------
    Points in the map frame in metres, body by body, shape (N, 3).
    """
    bodies = zip(world.dimensions, world.centres, world.R_map_body, strict=True)
    parts = [
        _above_floor(_surface(size, options.spacing) @ R.T + centre, options.height)
        for size, centre, R in bodies
    ]
    points = np.concatenate([np.zeros((0, 3)), *parts])
    return np.asarray(points + rng.normal(0.0, options.noise, points.shape))


def _above_floor(points: FloatArray, height: float) -> FloatArray:
    return points[(points[:, 2] > 0) & (points[:, 2] <= height)]


def _surface(size: FloatArray, spacing: float) -> FloatArray:
    """Return points on the faces of a box around the origin, each for an equal share of a face.

    Parameters
    ----------
    size
        Lengths of the sides in metres, shape (3,).
    spacing
        Largest distance of neighbours on a face in metres.
    """
    inner = [_centres(length, spacing) for length in size]
    faces = []
    for axis, side in product(range(3), (-0.5, 0.5)):
        coordinates = [*inner[:axis], np.array([side * size[axis]]), *inner[axis + 1 :]]
        faces.append(np.stack(np.meshgrid(*coordinates), axis=-1).reshape(-1, 3))
    return np.concatenate(faces)


def _centres(length: float, spacing: float) -> FloatArray:
    """Return the centres of equal parts, at most ``spacing`` long, of a length around zero."""
    count = int(np.ceil(length / spacing))
    return ((np.arange(count) + 0.5) / count - 0.5) * length

"""The cloud that a LiDAR would map of the steel in a hall."""

from itertools import product
from typing import Annotated

import numpy as np
from pydantic import Field

from l2m_gtsam.data import FloatArray
from l2m_gtsam.options import Options
from l2m_gtsam.simulate.solids import Solids
from l2m_gtsam.simulate.world import SteelWorld


class StructureOptions(Options):
    """How densely and how well the steel is seen."""

    spacing: Annotated[float, Field(ge=0.01)] = 0.05
    """Largest distance of neighbouring points on a surface in metres."""
    height: Annotated[float, Field(gt=0)] = 4.0
    """Height above the floor up to which surfaces are seen, in metres."""
    noise: Annotated[float, Field(ge=0)] = 0.01
    """Standard deviation of a point along each axis in metres."""


def structure_cloud(
    world: SteelWorld | Solids, options: StructureOptions, rng: np.random.Generator
) -> FloatArray:
    """Return points on the surfaces of all bodies, as far as these stand above the floor.

    Nothing hides anything: a hall is mapped from many places. What is buried, such as rebar and
    floor beams, is not seen.

    Parameters
    ----------
    world
        Bodies over the floor, z = 0.
    options
        Which points are seen, and how well.
    rng
        Source of randomness.

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
